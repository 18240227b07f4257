"""adaptfault forecast: the accuracy to expect after a repair, for a fault set or for the worst
faults of the array."""

from __future__ import annotations

from adaptfault.cli.adapt import Repairing
from adaptfault.cli.command import argument, option
from adaptfault.cli.diagnoses import fault_set
from adaptfault.cli.paths import Read, Stated, Written
from adaptfault.cli.shared_options import chosen_device, device_option, faults_option


class Forecast(Repairing):
    """Forecast the accuracy after a repair, before anything breaks."""

    example = """  adaptfault forecast robot.bundle --worst --picture worst.png
      which wire, which two wires and which pad would cost most accuracy after a repair
  adaptfault forecast model grasps/ --faults diagnosis.json
  adaptfault forecast robot.bundle --faults 3,17 --classes"""

    model: Read = argument(
        "folder written by adaptfault train or adapt --keep, or a bundle", "MODEL"
    )
    faults: Stated | None = faults_option()
    new: float | None = option(
        "with --faults: number of new recordings that the intervals are for (default: as many"
        " as validation has; inf: the expected accuracy itself)",
        "N",
    )
    classes: bool = option(
        "with --faults: the recall of each class as well, and what it is confused with"
    )
    worst: bool = option(
        "forecast each wire, each pad and pairs of the worst wires; lists the worst"
    )
    among: int = option("forecast all pairs of the N worst wires (default 5)", "N", default=5)
    picture: Written | None = option("with --worst: a map of what each wire costs", "PNG")
    device: str = device_option()

    def run(self) -> int:
        """Forecast."""
        if (self.faults is None) == (not self.worst):
            raise ValueError("give --faults F, or --worst")
        if self.picture is not None and not self.worst:
            raise ValueError("--picture needs --worst: it is a map of all wires")
        if self.new is not None and self.worst:
            raise ValueError("--new needs --faults")
        if self.classes and self.worst:
            raise ValueError("--classes needs --faults")
        adapter = self.open_adapter().to(chosen_device(self.device))
        if self.faults is not None:
            forecast = adapter.forecast(fault_set(self.faults, adapter.layout), recordings=self.new)
            text = str(forecast)
            if self.classes:
                text += f"\nclasses at the best measured stage:\n{forecast.by_class(_names(self))}"
            self.emit(forecast.to_dict(), text)
            return 0
        from adaptfault.adaptation.worst import worst_faults

        worst = worst_faults(adapter, among=self.among, say=self.say)
        if self.picture is not None:
            from adaptfault.data.atomic import atomic_figure

            atomic_figure(self.picture, worst.plot(), dpi=120)
        self.emit(worst.to_dict(), str(worst))
        return 0


add = Forecast.add


def _names(args: Forecast) -> tuple[str, ...]:
    """Return the names of the classes, where the model is stored with names."""
    from adaptfault.cli.trained_model import open_bundle
    from adaptfault.models.store import SCHEMA, read_manifest, schema_of

    bundle = open_bundle(args, args.model)
    if bundle is not None:
        return bundle.class_names
    if schema_of(args.model) != SCHEMA:
        return ()
    return tuple(read_manifest(args.model, SCHEMA)["class_names"])
