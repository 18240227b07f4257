"""What a sensor's own microcontroller does: a monitor in C, generated from a fitted diagnosis."""

from adaptfault.firmware.counting import CellState, CountingMonitor, Limits
from adaptfault.firmware.learning import learn_limits
from adaptfault.firmware.writing import monitor_source

__all__ = ["CellState", "CountingMonitor", "Limits", "learn_limits", "monitor_source"]
