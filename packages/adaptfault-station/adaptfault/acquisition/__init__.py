"""Acquisition: receives frames from sensors, orders and records them."""

from adaptfault.acquisition.ordering import Arrivals, Frame, Ordering
from adaptfault.acquisition.packet import (
    NotAuthentic,
    Packet,
    PacketError,
    format_packet,
    parse_packet,
    read_key,
)
from adaptfault.acquisition.receiver import Counters, Receiver
from adaptfault.acquisition.recorder import Recorded, Recorder
from adaptfault.acquisition.relay import FrameRepair, Relay, Relayed
from adaptfault.acquisition.session import Event, Session
from adaptfault.acquisition.station import Station
from adaptfault.acquisition.switch import Contact, Daily, Switch, parse_when

__all__ = [
    "Arrivals",
    "Contact",
    "Counters",
    "Daily",
    "Event",
    "Frame",
    "FrameRepair",
    "NotAuthentic",
    "Ordering",
    "Packet",
    "PacketError",
    "Receiver",
    "Recorded",
    "Recorder",
    "Relay",
    "Relayed",
    "Session",
    "Station",
    "Switch",
    "format_packet",
    "parse_packet",
    "parse_when",
    "read_key",
]
