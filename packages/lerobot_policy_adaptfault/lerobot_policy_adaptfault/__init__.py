"""Registers the step with LeRobot, whose commands import each installed package of such a name."""

from adaptfault.lerobot import TouchProcessorStep

__all__ = ["TouchProcessorStep"]
