"""Adapts the fault-free model to a fault set F, always from the fault-free weights, in stages of
increasing cost."""

from __future__ import annotations

import copy
from functools import cached_property
from typing import get_args

import numpy as np
import torch

from adaptfault.adaptation.fault_free import FaultFreeModel
from adaptfault.adaptation.forecast import Forecast
from adaptfault.adaptation.result import Adaptation
from adaptfault.adaptation.stages import Method, Run
from adaptfault.models.any_model import AnyModel, not_resettable
from adaptfault.models.targets import log_likelihood
from diagnostics import FaultSet
from diagnostics.faults import Cells


class Adapter(FaultFreeModel):
    """Repairs a fault-free model for any F.

    Windows without a label (y = -1) use the fault-free model's probabilities as targets.

    Args:
        model: the fault-free model, any module from x ``[N, T, D]`` (0..1 scale) to logits or
            values ``[N, n]``, or a policy from touch x and other inputs to actions of any shape, as
            chunks ``[N, H, A]``. It never changes. Computation is on the CPU, unless :meth:`to`
            moves it.
        train, validation: fault-free windows; more than 2500 validation windows are thinned evenly.
        A regression has
            targets y float ``[N, k]``, a policy actions of the shape that it returns. What else a
            policy sees is their ``extra``, which no repair changes; their
            recordings are its episodes, of which none is in both.
        layout: the array; None: ``model.layout``.
        features: feature vector for a new head: the name of a layer (its output), or a function of
            (module, x) that returns ``[N, p]``. None: the input of the last linear layer.
        task: "classification", "regression" or "auto" (from the shape of y).
        loss: of training, (outputs ``[B, n]``, y) -> scalar. None: cross entropy, or mean squared
            error.
        touch: the model takes one dict of inputs, as a policy of LeRobot does, with touch under
            this name. None: it takes touch first, and other inputs by name.

    Raises:
        TypeError: ``model`` is no torch module.
        ValueError: no windows or no layout; the model fails on a window, its output does not fit
            the targets, or the named features cannot be found; a policy that does not use touch, or
            an episode in both sets of windows.
    """

    def adapt(
        self,
        fault_set: Cells,
        *,
        method: Method = "auto",
        budget: float | None = None,
        seed: int = 0,
        progress: bool | None = None,
    ) -> Adaptation:
        """Return the model adapted to ``fault_set``, always from the fault-free weights: earlier F
        have no effect.

        Args:
            fault_set: F, over the D cells of the layout; a fault set, or a list of cells.
            method: "fill": the missing cells are imputed from the healthy ones, no training.
                "head": in addition, a new head is fitted in closed form to the features of the
                network and the healthy cells. "finetune": in addition, all parameters are trained,
                front end included, in rounds that each end with a new head; of a policy, after the
                fill and with its own last layer. "scratch": a new network is trained on the healthy
                cells, the paper's protocol. "auto": fill; head, unless validation loses beyond the
                noise by it; finetune, if a budget is given and the head keeps less than 99 % of the
                healthy accuracy. With F empty, "fill" is the fault-free model, bit for bit, and
                "auto" is :attr:`healthy`, that model with as good a head as a repair gets.
            budget: seconds for the stages after the fill; a stage that does not fit is left out.
                None: until validation stops improving.
            seed: of training.
            progress: show or hide progress on stderr; None shows it on a terminal.

        Raises:
            ValueError: an unknown method, one that this model does not allow, F over another number
                of cells, or no healthy cell left.
        """
        fault_set = self.check(fault_set, method)
        if method == "auto" and not len(fault_set):
            return self.healthy
        return Run(
            self, fault_set, budget, seed, progress, lambda: self.fault_free_accuracy
        ).execute(method)

    @cached_property
    def _healthy(self) -> Run:
        run = Run(self, FaultSet((), self.layout.n_cells), None, 0, False)
        run.execute("auto")
        return run

    @property
    def healthy(self) -> Adaptation:
        """The model for a sensor without faults: the fault-free model, with a new head where that
        helps validation.

        Repairs are compared with it, so that a sensor does not get better by a fault.
        """
        return self._healthy.done()

    @property
    def fault_free_accuracy(self) -> float:
        """Validation accuracy (R2 of a regression) of :attr:`healthy`, its head fitted without the
        scored windows."""
        return self._healthy.accuracy()

    def forecast(self, fault_set: Cells, *, recordings: float | None = None) -> Forecast:
        """Return the accuracy (R2 of a regression) to expect of each stage, from validation windows
        without F.

        It trains and deploys nothing and takes as long as ``method="head"``.

        Args:
            fault_set: F.
            recordings: number of new recordings whose accuracy the intervals hold, at most
                ``math.inf``: then they are intervals of the expected accuracy. None: as many as
                validation has.

        Raises:
            ValueError: F over another number of cells, no healthy cell left, or a number of
                recordings that is not positive.
        """
        fault_set = self.check(fault_set)
        if recordings is not None and not recordings > 0:
            raise ValueError(
                f"a forecast needs a positive number of new recordings, got {recordings}"
            )
        windows = self.validation
        outputs = {"fault-free": self._healthy.held_out()}
        if len(fault_set):
            run = Run(self, fault_set, None, 0, False)
            run.quick = self.compact
            outputs["fill"] = run.held_out()
            run.head()
            outputs["head"] = run.held_out()
        predicted = {name: out.numpy() for name, out in outputs.items()}
        likely = None
        if self.task == "classification":
            predicted = {name: out.argmax(1) for name, out in predicted.items()}
            likely = {name: np.exp(log_likelihood(out, windows.y)) for name, out in outputs.items()}
        return Forecast.of(fault_set, windows.y, windows.recording, predicted, recordings, likely)

    def to(self, device: str | torch.device) -> Adapter:
        """Return an adapter that works on a device, as "cuda"; this one stays. Its adaptations are
        on that device."""
        other = copy.copy(self)
        other.model = copy.deepcopy(self.model).to(device)
        other.__dict__.pop("compact", None)  # is on its own device
        return other

    def check(self, fault_set: Cells, method: Method = "auto") -> FaultSet:
        """Return F as a fault set; refuse an adaptation that is impossible.

        Raises:
            ValueError: an unknown method, one that this model does not allow, F over another number
                of cells, or no healthy cell left.
        """
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}: use one of {', '.join(get_args(Method))}")
        fault_set = FaultSet.of(fault_set, self.train.x.shape[2])
        if not self.layout.is_cell[fault_set.healthy].any():
            raise ValueError(
                f"F holds all {int(self.layout.present.sum())} cells: no healthy one is left to"
                " predict from; replace the sensor"
            )
        if isinstance(self.model, AnyModel):
            name = type(self.model.module).__name__
            module = self.model.module
            if method == "head" and not self.has_features:
                raise ValueError(
                    f"{name} has no linear layer to take features from: name a layer with features="
                )
            if method == "scratch" and not any(p.requires_grad for p in module.parameters()):
                raise ValueError(f"{name} has no trainable parameters: use another method")
            if method == "scratch" and (kinds := not_resettable(module)):
                raise ValueError(
                    f"{name} cannot be trained anew: {', '.join(kinds)} has parameters but no"
                    " reset_parameters()"
                )
        return fault_set
