"""The parameters of the node, and what they are when YAML read their text as another type. Needs no
ROS.

A ROS parameter is YAML: ``-p unit:=N`` is a bool, ``-p full_scale:=5`` an integer. On the command
line the text is still there, and is put in quotes where text is expected (:func:`quoted`). Values
of a parameter file are converted.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import Any

_ASSIGNMENT = re.compile(r"((?:[^:]+:)?(\w+)):=(.*)", re.DOTALL)
# as use_sim_time, and qos_overrides./tactile.subscription.depth
_OF_EVERY_NODE = ("use_sim_time", "qos_overrides", "start_type_description_service")
_OF_TOPICS = ("topic", "restored")
_BOOLS = {"true": True, "false": False, "1": True, "0": False}


@dataclass(frozen=True)
class Parameters:
    """The parameters of the node.

    Attributes:
        topic: of the frames; several, as "/finger/0,/finger/1" or a list, are pads of one array in
            this order.
        topic_type: of its messages, as "sensor_msgs/msg/Image".
        field: the array of numbers in a message that holds the readings, dotted, as
            "sensors.values"; "" = the only one.
        bundle: folder of ``adaptfault train --out X.bundle``: layout, healthy model, calibration,
            known faults, and how the active version undoes exchanged wires and replaced pads.
        trust: PEM file of the public key that must have signed the bundle; "" = signatures are not
            checked.
        restored: topic of the restored frames, one for each ``topic``; "" = none. Needs a bundle.
            Of several topics the default is each with "/restored" behind it.
        scan: topic of the scans of a read-out that tests itself, of the same type: the level, then
            one value a cell; "" = none.
        lines_held: whether the read-out holds lines that it does not select in a scan.
        layout: without a bundle: a layout file, or a shape as 2x11x10.
        full_scale, unit, rate: override those of ``layout``; 0 and "" keep them.
        name: begins the name of each status, for robots with several sensors.
        hardware_id: of the sensor, in each status.
        autostart: configure and activate at the start, without a lifecycle manager.
    """

    topic: str = "/tactile"
    topic_type: str = "std_msgs/msg/Float32MultiArray"
    field: str = ""
    bundle: str = ""
    trust: str = ""
    restored: str = "/tactile/restored"
    scan: str = ""
    lines_held: bool = False
    layout: str = ""
    full_scale: float = 0.0
    unit: str = ""
    rate: float = 0.0
    name: str = "tactile"
    hardware_id: str = "tactile"
    autostart: bool = True

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Parameters:
        """Return the parameters from values of any type; None stands for the default.

        Raises:
            ValueError: a value cannot be converted to the type of its parameter.
        """
        given = {
            name: _converted(name, value) for name, value in values.items() if value is not None
        }
        return cls(**given)

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of the frames."""
        return _names(self.topic)

    @property
    def restored_topics(self) -> tuple[str, ...]:
        """The topics of the restored frames, one for each of :attr:`topics`; none, where none is
        restored.

        Raises:
            ValueError: another number of them.
        """
        if self.restored == DEFAULTS["restored"] and len(self.topics) > 1:
            return tuple(f"{topic}/restored" for topic in self.topics)
        names = _names(self.restored)
        if names and len(names) != len(self.topics):
            raise ValueError(
                f"parameter restored names {len(names)} topics, topic {len(self.topics)}: name one"
                " for each"
            )
        return names


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


DEFAULTS: dict[str, Any] = {field.name: field.default for field in fields(Parameters)}


def unknown(names: Iterable[str]) -> list[str]:
    """Return one sentence for each name that is no parameter of the node.

    Args:
        names: of the parameters that were given; those that every ROS node has are left out.

    Raises:
        ValueError: a name that is nearly one of a parameter.
    """
    told = []
    for name in sorted(names):
        if name in DEFAULTS or name.split(".")[0] in _OF_EVERY_NODE:
            continue
        near = get_close_matches(name, DEFAULTS, n=1)
        if near:
            raise ValueError(f"parameter {name}: there is none; did you mean {near[0]}?")
        told.append(f"parameter {name} is not used; there are {', '.join(DEFAULTS)}")
    return told


def quoted(arguments: Sequence[str]) -> list[str]:
    """Return command line arguments with the values of text parameters in quotes, so that YAML
    reads them as text.

    Args:
        arguments: as ``["--ros-args", "-p", "unit:=N"]``; what is in quotes already stays.
    """
    result = list(arguments)
    inside = False
    for i, argument in enumerate(arguments):
        if argument in ("--ros-args", "--"):
            inside = argument == "--ros-args"
        elif inside and i and arguments[i - 1] in ("-p", "--param"):
            result[i] = _quoted(argument)
    return result


def _quoted(assignment: str) -> str:
    match = _ASSIGNMENT.fullmatch(assignment)
    if match is None:
        return assignment
    target, name, value = match.groups()
    if not isinstance(DEFAULTS.get(name), str) or value.startswith(("'", '"')):
        return assignment
    return f"{target}:={json.dumps(value, ensure_ascii=False)}"


def _converted(name: str, value: Any) -> Any:
    default = DEFAULTS[name]
    if isinstance(default, bool):
        return _truth(name, value)
    if isinstance(default, float):
        return _number(name, value)
    return _text(name, value)


def _truth(name: str, value: Any) -> bool:
    found = _BOOLS.get(str(value).lower())
    if found is None:
        raise ValueError(f"parameter {name}: {value!r} is neither true nor false")
    return found


def _number(name: str, value: Any) -> float:
    number = math.nan
    if not isinstance(value, bool):
        with suppress(TypeError, ValueError):
            number = float(value)
    if not 0 <= number < math.inf:
        raise ValueError(f"parameter {name}: expected a number from 0, got {value!r}")
    return number


def _text(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name in _OF_TOPICS and isinstance(value, list) and all(isinstance(v, str) for v in value):
        return ",".join(value)
    if name == "unit" and value is False:
        return "N"  # YAML reads no, off and false so, too; no unit has these names
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"parameter {name}: YAML reads it as {value!r}; write the text in quotes")
    return f"{value:.15g}" if isinstance(value, float) else str(value)
