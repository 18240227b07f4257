"""Acquisition: frames as they come from the sensor, put in order and recorded."""

from adaptfault.acquisition.ordering import Arrivals, Frame, Ordering
from adaptfault.acquisition.packet import Packet, PacketError, format_packet, parse_packet
from adaptfault.acquisition.receiver import Counters, Receiver
from adaptfault.acquisition.recorder import Recorded, Recorder
from adaptfault.acquisition.switch import Contact, Daily, Switch, parse_when

__all__ = [
    "Arrivals",
    "Contact",
    "Counters",
    "Daily",
    "Frame",
    "Ordering",
    "Packet",
    "PacketError",
    "Receiver",
    "Recorded",
    "Recorder",
    "Switch",
    "format_packet",
    "parse_packet",
    "parse_when",
]
