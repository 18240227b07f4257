"""adaptfault adapt: adapts a model to a fault set F, or forecasts its accuracy under F."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from adaptfault.cli.command import argument, option
from adaptfault.cli.diagnoses import fault_set
from adaptfault.cli.paths import Read, Stated, WrittenFolder
from adaptfault.cli.reading import Reading, perhaps_recordings
from adaptfault.cli.shared_options import Trusting, chosen_device, device_option, faults_option

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from diagnostics import FaultSet


class Repairing(Trusting, Reading):
    """What a command has that opens an adapter."""

    takes_targets = True
    model: Read
    recordings: list[Read] = perhaps_recordings()
    faults: Stated | None = faults_option()
    device: str = device_option()

    def open_adapter(self) -> Adapter:
        """Return a kept adapter, a bundle's, or a new one for the model and its recordings."""
        from adaptfault.adaptation.adapter_files import SCHEMA, load_adapter
        from adaptfault.cli.trained_model import TrainedModel, open_bundle
        from adaptfault.models.store import schema_of

        bundle = open_bundle(self, self.model)
        is_kept = bundle is None and schema_of(self.model) == SCHEMA
        if self.recordings and (bundle is not None or is_kept):
            raise ValueError(f"{self.model} holds its own windows: leave the recordings out")
        if bundle is not None:
            return bundle.parts.adapter()
        if is_kept:
            return load_adapter(self.model)
        from adaptfault.adaptation.adapter import Adapter

        if not self.recordings:
            raise ValueError(
                f"{self.model} is a model: give the fault-free recordings that it was trained on,"
                " too"
            )
        trained = TrainedModel.open(self, self.model)
        train, validation, _ = trained.parts(trained.recordings(self, self.recordings))
        return Adapter(trained.network, train, validation)


class Adapt(Repairing):
    """Repair a model for a set of faulty cells."""

    example = """  adaptfault adapt model grasps/ --faults diagnosis.json --out adapted
      grasps/: the fault-free recordings that the model was trained on
  adaptfault adapt model grasps/ --keep adapter
      stores what a robot needs to adapt without the recordings, at most 20 MB; then, on the robot:
  adaptfault adapt adapter --faults 3,17 --forecast"""

    model: Read = argument("folder written by adaptfault train or --keep, or a bundle", "MODEL")
    faults: Stated | None = faults_option()
    out: WrittenFolder | None = option("where the adapted model goes", "FOLDER")
    forecast: bool = option("print the accuracy to expect, and adapt only with --out")
    keep: WrittenFolder | None = option(
        "store everything that later adaptations need, without recordings", "FOLDER"
    )
    method: Literal["auto", "fill", "head", "finetune", "scratch"] = option(
        "method of adaptation (default auto: the first that is accurate enough)",
        default="auto",
    )
    budget: float | None = option("seconds of training allowed", "S")
    seed: int = option("random seed of training (default 0)", default=0)
    device: str = device_option()

    def run(self) -> int:
        """Keep the adapter, forecast, adapt and save, as the options state."""
        if self.faults is None and self.keep is None:
            raise ValueError(
                "nothing to do: give --faults F with --out or --forecast, or --keep FOLDER"
            )
        if (self.faults is None) != (self.out is None and not self.forecast):
            raise ValueError(
                "--faults F needs --out FOLDER or --forecast, and either of them needs --faults F"
            )
        adapter = self.open_adapter()
        result: dict[str, Any] = {"schema": "adaptfault.adapt/1"}
        lines: list[str] = []
        if self.keep is not None:
            from adaptfault.adaptation.adapter_files import save_adapter

            save_adapter(self.keep, adapter)
            result["kept"] = self.keep
            lines.append(f"adapter kept: {self.keep}")
        if self.faults is not None:
            faults = fault_set(self.faults, adapter.model.layout)
            adapter = adapter.to(chosen_device(self.device))
            if self.forecast:
                self.say(
                    f"{len(faults)} of {adapter.model.layout.present.sum()} cells are faulty;"
                    " forecasting"
                )
                forecast = adapter.forecast(faults)
                result["forecast"] = forecast.to_dict()
                lines.append(str(forecast))
            if self.out is not None:
                _adapt(self, self.out, adapter, faults, result, lines)
        self.emit(result, "\n".join(lines))
        return 0


add = Adapt.add


def _adapt(
    args: Adapt,
    out: str,
    adapter: Adapter,
    faults: FaultSet,
    result: dict[str, Any],
    lines: list[str],
) -> None:
    verb = "is" if len(faults) == 1 else "are"
    cells = adapter.model.layout.present.sum()
    args.say(f"{len(faults)} of {cells} cells {verb} faulty; adapting")
    adaptation = adapter.adapt(
        faults, method=args.method, budget=args.budget, seed=args.seed, progress=args.progress
    )
    adaptation.save(out)
    result |= {
        "adapted": out,
        "fault_set": list(faults),
        "fault_free_accuracy": adapter.fault_free_accuracy,
        "scores": adaptation.scores.to_dict(),
        "stages": [vars(stage) for stage in adaptation.stages],
    }
    sets = adaptation.conformal.size if adaptation.task == "classification" else None
    result["set_size"] = sets
    lines += [
        f"validation, fault-free: {adapter.measure} {adapter.fault_free_accuracy:.3f}",
        f"validation, {len(faults)} cells removed: {adaptation.scores}",
        *([] if sets is None else [f"sets that hold the class at 90 %: {sets:.2f} classes"]),
        *(f"  {stage}" for stage in adaptation.stages),
        f"adapted model: {out}",
    ]
