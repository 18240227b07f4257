"""When a policy must not act on touch: what was measured of the sensor and its repair says so."""

from __future__ import annotations

from dataclasses import dataclass

from adaptfault.acquisition.followed import Sensor
from diagnostics import FaultSet


class NotCertified(RuntimeError):
    """The policy must not act on this sensor as it is."""


@dataclass(frozen=True)
class Limits:
    """What must hold; None: it need not.

    Attributes:
        most_false_alarms: bound of the share of healthy logs that are blamed
            (:attr:`diagnostics.SelfDiagnosis.certificate_`), 0 to 1.
        min_recall: lower limit of the recall of each class by the version that runs, above 0 to 1
            (:meth:`adaptfault.Bundle.allows`). Cells that were found faulty since that version was
            made count against it.
        largest_error: standard deviation of the error of a filled cell, in the unit of the array.

    Raises:
        ValueError: a limit that nothing can meet, or that is no share.
    """

    most_false_alarms: float | None = None
    min_recall: float | None = None
    largest_error: float | None = None

    def __post_init__(self) -> None:
        for name in ("most_false_alarms", "min_recall"):
            limit = getattr(self, name)
            if limit is not None and not 0 < limit <= 1:
                raise ValueError(f"{name}={limit}: expected a share above 0, at most 1")
        if self.largest_error is not None and not self.largest_error > 0:
            raise ValueError(
                f"largest_error={self.largest_error}: expected a reading above 0, in the unit of"
                " the array"
            )

    def refusal(self, sensor: Sensor, faulty: FaultSet) -> str | None:
        """Return why the policy must not act while these cells are faulty; None: it may."""
        reasons = (
            self._of_diagnosis(sensor),
            self._of_classes(sensor, faulty),
            self._of_fill(sensor, faulty),
        )
        return next((reason for reason in reasons if reason is not None), None)

    def _of_diagnosis(self, sensor: Sensor) -> str | None:
        if self.most_false_alarms is None:
            return None
        certificate = sensor.diagnoser.certificate_
        if certificate is None:
            return (
                "the bundle has no bound of false alarms; ask SelfDiagnosis.certificate_ before"
                " Bundle.create"
            )
        if certificate.false_alarms <= self.most_false_alarms:
            return None
        return f"most_false_alarms is {self.most_false_alarms:.1%}, and {certificate}"

    def _of_classes(self, sensor: Sensor, faulty: FaultSet) -> str | None:
        if self.min_recall is None:
            return None
        assert sensor.bundle is not None  # for the type checker
        found = faulty - sensor.known
        if found:
            return (
                f"{len(found)} cells were found faulty since {sensor.version} was made, and no"
                " recall is known without them; run adaptfault maintain"
            )
        recalls = sensor.bundle.class_recalls()
        if not recalls:
            return f"no recall of a class is known of {sensor.version}; run adaptfault maintain"
        low = min(recalls, key=lambda one: one.low)
        if low.low >= self.min_recall:
            return None
        return f"min_recall is {self.min_recall}, and {low.named(sensor.bundle.class_names)}"

    def _of_fill(self, sensor: Sensor, faulty: FaultSet) -> str | None:
        if self.largest_error is None or not faulty:
            return None
        assert sensor.restorer is not None  # for the type checker
        deviation = sensor.restorer.deviation(faulty)
        worst = int(deviation.argmax())
        if deviation[worst] <= self.largest_error:
            return None
        unit = sensor.layout.unit
        return (
            f"largest_error is {self.largest_error:g} {unit}, and {sensor.layout.place(worst)} is"
            f" filled with a standard error of {deviation[worst]:.3g} {unit}"
        )
