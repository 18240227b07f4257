"""Touch for policies of LeRobot: dead cells are marked and filled, frame by frame."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adaptfault.lerobot.step import TouchProcessorStep

__all__ = ["LEROBOT", "TouchProcessorStep"]

LEROBOT = "0.4.4"
"""The version of LeRobot that the step was written for, and tried with."""


def __getattr__(name: str) -> Any:
    if name != "TouchProcessorStep":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    check_version()
    from adaptfault.lerobot.step import TouchProcessorStep

    return TouchProcessorStep


def check_version() -> None:
    """Raise ImportError unless the LeRobot that the step was written for is installed."""
    try:
        found = version("lerobot")
    except PackageNotFoundError:
        raise ImportError(
            f"TouchProcessorStep needs LeRobot, which is not installed: pip install"
            f" lerobot=={LEROBOT}"
        ) from None
    if found != LEROBOT:
        raise ImportError(
            f"TouchProcessorStep was written for LeRobot {LEROBOT}, and {found} is installed: pip"
            f" install lerobot=={LEROBOT}"
        )
