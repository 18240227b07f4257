"""Codes of what ``check`` tells: one for each kind of fault and each finding, the same for ever.

A code says what was found, why it matters to whoever trains, how far it can be trusted, and what
is not found. How bad it is stands in :mod:`adaptfault.inspection.severity`, what is faulty in the
finding itself. Numbers are never used again:

- 100 to 119 cells and wires, by the kind of the fault
- 120 to 139 what the whole array or a pad does
- 140 to 159 frames, readings and times
- 160 to 179 recordings that mislead whoever trains on them
- 190 to 199 what was not checked; such a finding is never a pass
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, get_args

from adaptfault.inspection.severity import Name, of_finding
from diagnostics.faults import FaultKind

Need = Literal["reference", "classes", "times"]
"""What is compared: healthy recordings, the classes of the recordings, the times of the frames."""

LEVELS = ("notice", "warning", "error", "error")
"""What linters call the severities 0 to 3."""

PREFIX = "TOUCH-"

_UNCHECKED = 190  # numbers from here on tell what was not checked


@dataclass(frozen=True)
class Code:
    """One code.

    Attributes:
        number: behind ``TOUCH-``.
        kind: of the fault, or name of the finding.
        what: was found.
        why: it matters to whoever trains.
        limits: when it is not to be trusted, or not looked for.
        missed: what is not found; empty where ``method`` says so.
        method: the module that finds it, whose docstring says how.
        needs: what has to be given so that it is looked for.
    """

    number: int
    kind: FaultKind | Name
    what: str
    why: str
    limits: str
    missed: str = ""
    method: str = ""
    needs: Need | None = None

    def __str__(self) -> str:
        return f"{PREFIX}{self.number}"

    @property
    def name(self) -> str:
        """What a program asks for: a kind of fault, or the name of a finding."""
        return str(self.kind)

    @property
    def is_unchecked(self) -> bool:
        """Whether it tells what was not checked."""
        return self.number >= _UNCHECKED

    @property
    def not_found(self) -> str:
        """What is not found, in one paragraph."""
        return self.missed or _not_detected(self.method)

    @property
    def severity(self) -> str:
        """How bad it is, in words."""
        if self.number < 120:
            return f"{LEVELS[1]}; {LEVELS[2]} where a wire or a tenth of the cells is faulty"
        return LEVELS[of_finding(_NAME_OF[self.name])]

    def text(self) -> str:
        """Return everything that is to say of the code, for a terminal."""
        rows = {
            "what": self.what,
            "why": self.why,
            "level": self.severity,
            "limits": self.limits,
            "not found": self.not_found,
            "needs": "" if self.needs is None else _NEEDS[self.needs],
            "method": self.method,
        }
        told = [f"{name:10s}{text}" for name, text in rows.items() if text]
        return "\n".join([f"{self} {self.name}", *told])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "code": str(self),
            "name": self.name,
            "what": self.what,
            "why": self.why,
            "level": self.severity,
            "limits": self.limits,
            "not_found": self.not_found,
            "needs": self.needs,
            "method": self.method or None,
        }


_NAME_OF: Mapping[str, Name] = {name: name for name in get_args(Name)}

_NEEDS: Mapping[Need, str] = {
    "reference": "healthy recordings: --reference FILE, or --healthy FIRST:LAST",
    "classes": "recordings with classes: tasks of the data set, --labels, --label-column",
    "times": "times of the frames: --time-column",
}

_STILL = (
    "Cells that no contact reached are told as not tested, and so are cells under an object that"
    " lies still."
)
_MOVING = "Cells that move nearly as they should."
_DEAD = (
    "Each policy normalises with it, and learns to ignore or to trust a value that says nothing."
)

CODES: tuple[Code, ...] = (
    Code(
        100,
        "fault",
        "A cell is faulty; its kind is not known.",
        _DEAD,
        "Only of findings that were stored without the fault.",
        _STILL,
    ),
    Code(
        101,
        FaultKind.OPEN,
        "A cell or a wire reads what an untouched one reads, whatever touches it.",
        _DEAD,
        "A cell that is touched nowhere in the data set looks the same, and is told as not tested.",
        _STILL,
    ),
    Code(
        102,
        FaultKind.SHORT,
        "A cell or a wire reads full scale, whatever touches it.",
        "It dominates every mean and maximum of its pad.",
        "Full scale has to be right: --full-scale.",
        _STILL,
    ),
    Code(
        103,
        FaultKind.STUCK,
        "A cell or a wire holds one value within the range, with or without dither.",
        _DEAD,
        "An object that lies still from the first frame to the last holds its cells, too.",
        _STILL,
    ),
    Code(
        104,
        FaultKind.ALIAS,
        "A row, a column or a cell reads another one: an address bit or a bridge.",
        "A contact appears twice, at places that one finger never touches together.",
        "Lines that every contact loads alike cannot be told apart.",
        "Lines that agree in the reference as well.",
    ),
    Code(
        105,
        FaultKind.INTERMITTENT,
        "A cell or a wire blinks between its load and a rail, or fails in some recordings.",
        "Contacts vanish and return; a policy learns to wait, or to grip harder.",
        "Frames must be fast enough that a blink is none of the contact.",
        "A loose contact in less than a third of the recordings may be missed.",
    ),
    Code(
        106,
        FaultKind.NOISY,
        "A cell reads its load and far more noise than the others under the same load.",
        "Small contacts drown in it; thresholds fire without contact.",
        "Noise that all cells share is TOUCH-128.",
        "Noise that the cell had in the reference.",
    ),
    Code(
        107,
        FaultKind.DRIFT,
        "The offset or the gain of a cell changes in the course of the log.",
        "The same contact has another value early and late, as tasks and days have.",
        "Materials creep under a long contact; a drift goes on without one.",
        "Slow changes that all cells share, and a gain above half of the usual in a short log.",
    ),
    Code(
        108,
        FaultKind.FLOATING,
        "A cell or a wire moves by itself, whatever touches it: a broken wire of high impedance.",
        "It looks alive in every statistic of its own, and carries a signal of something else.",
        "It is told against what the other cells say, so these must work.",
        _MOVING,
    ),
    Code(
        109,
        FaultKind.LATE,
        "A cell reads its load some frames late.",
        "Order of contacts, slip and direction come out wrong.",
        "The delay must be longer than contacts take to cross the cells beside.",
        _MOVING,
    ),
    Code(
        110,
        FaultKind.COPY,
        "A cell repeats another one, or the mean of those beside it.",
        "A contact is counted twice, and nobody sees what touches the cell itself.",
        "Cells in a dead band that flicker to the same value are none.",
        "A copy of a cell that is loaded like its own in every contact.",
    ),
    Code(
        111,
        FaultKind.CLAMPED,
        "A cell reads its load up to a limit below full scale.",
        "Strong contacts look alike there.",
        "All cells together at one limit are TOUCH-130.",
        "A limit that no contact of the data set reaches.",
    ),
    Code(
        112,
        FaultKind.WEAK,
        "A cell or a wire reads a share of its load.",
        "Its contacts look light, or far away.",
        "Needs contacts that load it and those beside it together.",
        "A share above half, in a short log.",
    ),
    Code(
        119,
        "wire",
        "A wire is faulty; its kind is not known.",
        _DEAD,
        "Only of findings that were stored without the fault.",
        _STILL,
    ),
    Code(
        120,
        "rewired",
        "Rows, columns or pads answer in each other's place, against the reference.",
        "A contact appears at another place than before.",
        "A pad that is loaded symmetrically reads alike either way.",
        "Lines that no contact loads differently.",
        method="diagnostics.sensor.rewiring",
        needs="reference",
    ),
    Code(
        121,
        "transposed",
        "A pad is read column by column in place of row by row.",
        "A contact appears at another place than before.",
        "Told as TOUCH-120 where the commands put the wiring back.",
        "Lines that no contact loads differently.",
        method="diagnostics.sensor.rewiring",
        needs="reference",
    ),
    Code(
        122,
        "replaced_pad",
        "Gain and offset of each cell of a pad are new: another pad of the same kind.",
        "A model that was trained on the old pad reads other forces.",
        "Another cover or supply changes all cells alike, and is TOUCH-124.",
        method="diagnostics.sensor.recalibration",
        needs="reference",
    ),
    Code(
        123,
        "another_sensor",
        "Some recordings are of another sensor than the rest.",
        "A model learns to tell the two, where tasks or robots go with them.",
        "Needs a reference of one of them.",
        method="diagnostics.sensor.another_sensor",
        needs="reference",
    ),
    Code(
        124,
        "gain",
        "The gain of the whole sensor or of a pad is another than in the reference.",
        "The same contact has another value.",
        "Other objects or tasks than in the reference look like a change of the gain.",
        method="diagnostics.sensor.sensor_change",
        needs="reference",
    ),
    Code(
        125,
        "offset",
        "The whole sensor or a pad rests at another value than in the reference.",
        "Thresholds of contact are off.",
        "A load that lies on the pad throughout is an offset, too.",
        method="diagnostics.sensor.sensor_change",
        needs="reference",
    ),
    Code(
        126,
        "ramp",
        "What all cells of a pad rest at moves in the course of a recording.",
        "The begin and the end of a recording look like different contacts.",
        "It is taken out before cells are judged.",
        method="diagnostics.sensor.common_mode",
        needs="reference",
    ),
    Code(
        127,
        "hum",
        "All cells of a pad move together: hum of the supply.",
        "A contact and the mains look alike.",
        "It is taken out before cells are judged.",
        method="diagnostics.sensor.common_mode",
        needs="reference",
    ),
    Code(
        128,
        "noise",
        "The noise of all cells is higher than in the reference.",
        "Small contacts drown in it.",
        "Needs five recordings.",
        method="diagnostics.sensor.disturbance",
        needs="reference",
    ),
    Code(
        129,
        "quantised",
        "Readings come in coarser steps than in the reference: the converter lost bits.",
        "Small contacts read 0.",
        "Needs five recordings.",
        method="diagnostics.sensor.disturbance",
        needs="reference",
    ),
    Code(
        130,
        "saturated",
        "Many loaded readings are at one highest value below full scale.",
        "Strong contacts look alike.",
        "Needs five recordings.",
        method="diagnostics.sensor.disturbance",
        needs="reference",
    ),
    Code(
        131,
        "crosstalk",
        "Each cell reads a share of the highest reading of its row or column.",
        "Contacts look like crosses.",
        "Needs five recordings and four cells a line.",
        method="diagnostics.sensor.crosstalk",
    ),
    Code(
        132,
        "normalised",
        "Each frame was scaled by its own least and highest reading.",
        "Force is gone from the data; nothing can be judged, and nobody learns it back.",
        "Fewer than three cells show nothing.",
        method="diagnostics.sensor.disturbance",
    ),
    Code(
        133,
        "one_signal",
        "Many cells show one signal: the multiplexer does not step.",
        "What looks like an array is one cell.",
        "Cells that are loaded alike everywhere differ in rest and gain by more than this allows.",
        method="diagnostics.sensor.one_signal",
    ),
    Code(
        134,
        "silent_array",
        "No reading of any cell ever changes, or none is in the range of the converter.",
        "There is nothing to learn from.",
        "Without a reference a data set in which nothing is touched looks the same.",
        method="diagnostics.sensor.disturbance",
    ),
    Code(
        135,
        "swapped_in_part",
        "Lines or pads answer in each other's place in some of the recordings.",
        "The same contact is at two places, by recording.",
        "Needs a reference, and four recordings.",
        method="diagnostics.sensor.swapped_in_part",
        needs="reference",
    ),
    Code(
        140,
        "frozen",
        "One frame came many times in a row while cells were loaded: the stream stood still.",
        "A policy learns that nothing happens for a while after a contact.",
        "A logger that always repeats frames is TOUCH-142.",
        "A stream that stands still while fewer than three cells are loaded.",
        method="diagnostics.preprocessing.transport",
    ),
    Code(
        141,
        "lost_frames",
        "Frames came without any reading.",
        "What replaces them is no measurement.",
        "Frames that were never written are TOUCH-147.",
        "Frames of which a part of the cells is missing.",
        method="diagnostics.preprocessing.transport",
    ),
    Code(
        142,
        "repeated_frames",
        "The logger is faster than the sensor: most frames repeat the one before.",
        "The rate of touch is a part of the stated one; windows hold fewer readings than they say.",
        "Looked for in 64 recordings at most.",
        method="diagnostics.sensor.repeated_frames",
    ),
    Code(
        143,
        "corrupt_frame",
        "A frame is no measurement: bytes were exchanged, lost or replaced.",
        "One such frame sets the range that every policy normalises with.",
        "A blow on the whole array stays, as it is none.",
        method="diagnostics.sensor.odd_frames",
    ),
    Code(
        144,
        "common_spike",
        "All cells jump by the same amount for one frame: supply, bus or a discharge.",
        "It looks like a contact of the whole array.",
        "A frame is left out where three quarters of the cells agree.",
        method="diagnostics.sensor.odd_frames",
    ),
    Code(
        145,
        "sentinel",
        "One number outside the range stands where the driver has no value.",
        "It sets the range that every policy normalises with.",
        "A number within the range cannot be told from a reading.",
        "Several such numbers, where none of them is the most frequent by far.",
    ),
    Code(
        146,
        "missing",
        "Readings are missing.",
        "NaN passes into means, quantiles and losses.",
        "Infinite readings count as missing.",
        "Values that stand for a missing reading within the range.",
    ),
    Code(
        147,
        "time_gaps",
        "Frames are missing between the times of the others.",
        "Speeds come out too high there.",
        "Hidden where times jitter by more than a fifth of the period.",
        method="adaptfault.data.recordings.facts.rates",
        needs="times",
    ),
    Code(
        148,
        "clock_disorder",
        "The clock falls back, or frames are in the wrong order.",
        "Contacts are read backwards there.",
        "Frames with equal times have no order.",
        method="adaptfault.data.recordings.facts.rates",
        needs="times",
    ),
    Code(
        149,
        "jitter",
        "The period between frames varies by more than a fifth.",
        "Frames are not equally spaced, as windows assume.",
        "Told of the times as written, which may be those of the logger.",
        method="adaptfault.data.recordings.facts.rates",
        needs="times",
    ),
    Code(
        160,
        "coincides",
        "A fault separates classes: it shows in nearly all recordings of some and in hardly any"
        " other.",
        "A model learns the fault for the class, and its validation shows nothing.",
        "Of a data set that is inspected part by part it is not looked for.",
        "A fault that shows in a part of a class.",
        needs="classes",
    ),
    Code(
        161,
        "static_load",
        "Something lies still on the array: an object or a strap.",
        "Its load is in each reading of its cells.",
        "Its cells are not tested.",
        method="diagnostics.decision.static_loads",
        needs="reference",
    ),
    Code(
        162,
        "begins_in_contact",
        "Recordings begin in contact.",
        "A driver that tares at the start takes the contact out.",
        "Harmless where nothing tares.",
        method="adaptfault.inspection.data_set",
    ),
    Code(
        163,
        "tared_in_contact",
        "Readings fall below rest, as after a tare in contact.",
        "The same contact has another value in these recordings.",
        "Needs three recordings.",
        method="adaptfault.inspection.data_set",
    ),
    Code(
        190,
        "untested",
        "So few cells were tested that faults may be hidden, or none of a pad.",
        "What was not tested is not healthy.",
        "Touches that would test more are told.",
        "What contacts a policy will meet that the data set does not hold.",
    ),
    Code(
        191,
        "unread",
        "Files or recordings could not be read, and were left out.",
        "What was not read was not checked.",
        "The errors above name each with the reason.",
        "Files whose suffix no reader knows.",
    ),
)

BY_NAME: Mapping[str, Code] = {code.name: code for code in CODES}
"""The code of each kind of fault and each name of a finding."""

BY_CODE: Mapping[str, Code] = {str(code): code for code in CODES}


def code_of(text: str) -> Code:
    """Return the code that a text names: ``TOUCH-103``, ``103``, or what it tells, as ``stuck``.

    Raises:
        ValueError: it names none.
    """
    wanted = text.strip()
    upper = wanted.upper()
    for known, key in ((BY_CODE, upper), (BY_CODE, f"{PREFIX}{upper}"), (BY_NAME, wanted.lower())):
        if key in known:
            return known[key]
    raise ValueError(
        f"{text!r} is no code; expected one of {CODES[0]} to {CODES[-1]}, or a name as"
        f" {FaultKind.STUCK}; adaptfault explain lists them"
    )


def unchecked(given: set[Need]) -> dict[Need, list[Code]]:
    """Return the codes that nobody looked for, by what they need and was not given."""
    left: dict[Need, list[Code]] = {}
    for code in CODES:
        if code.needs is not None and code.needs not in given:
            left.setdefault(code.needs, []).append(code)
    return left


def how_to_give(need: Need) -> str:
    """Return what has to be given, with the options that do."""
    return _NEEDS[need]


def _not_detected(module: str) -> str:
    """Return what the docstring of a module says that it does not detect."""
    for paragraph in (import_module(module).__doc__ or "").split("\n\n"):
        _, _, said = " ".join(paragraph.split()).partition("Not detected: ")
        if said:
            return said[0].upper() + said[1:]
    return ""
