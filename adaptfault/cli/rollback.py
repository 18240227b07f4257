"""adaptfault rollback: returns to the previous version."""

from __future__ import annotations

from adaptfault.cli.paths import Read
from adaptfault.cli.shared_options import Trusting, bundle_argument


class Rollback(Trusting):
    """Return to the previous version."""

    example = "  adaptfault rollback robot.bundle"
    decides = True

    bundle: Read = bundle_argument()

    def run(self) -> int:
        """Roll back."""
        from adaptfault.robot.sensor_state import SensorState

        bundle = self.opened(self.bundle)
        left = bundle.active().number
        version = bundle.rollback()
        unhandled = [fault.reason for fault in SensorState.of(bundle).unhandled]
        result = {
            "schema": "adaptfault.rollback/1",
            "left": left,
            "version": version.number,
            "not_handled": unhandled,
        }
        lines = [f"running: {version}; version {left} is not deployed for the same faults again"]
        self.emit(
            result, "\n".join([*lines, *(f"not handled now: {reason}" for reason in unhandled)])
        )
        return 0


add = Rollback.add
