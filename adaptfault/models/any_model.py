"""Wraps any torch module from windows to logits, values or actions, and finds the features that a
new head can use.

A policy sees more than touch and returns actions of any shape, as chunks ``[N, H, A]``. What else
it sees passes through by name; its actions are values ``[N, H A]`` to all that repairs it. The
closed-form head of a policy whose last layer gives each step of the chunk sees the features of all
steps, side by side.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from adaptfault.models.builders import ModelNotAllowed, build_model, builder_of, first_line
from adaptfault.models.network import TactileTransformer, WindowModel, evaluating
from diagnostics import SensorLayout

Features = str | Callable[..., Tensor]
_PROBE = 3  # windows of the test run; not 1 or 2, so that a batch axis in another place is noticed


class AnyModel(WindowModel):
    """A module from windows ``[N, T, D]`` to outputs ``[N, n]``, or to actions ``[N, ...]``, with
    the attributes that an adaptation needs.

    Args:
        module: the model.
        layout: the array.
        length: T, frames in a window.
        n_classes: n, number of logits or values.
        layer: name of the layer whose input (``last_linear`` True) or output is the feature vector;
            None: no features.
        last_linear: ``layer`` is the last linear layer.
        function: computes the features from (module, x) instead of ``layer``.
        shape: of the actions of a window, of ``n_classes`` numbers; None: ``[n_classes]``.
        touch: the module takes a dict, with touch under this name; None: it takes touch first, and
            what else it sees by name.
    """

    def __init__(
        self,
        module: nn.Module,
        layout: SensorLayout,
        length: int,
        n_classes: int,
        *,
        layer: str | None = None,
        last_linear: bool = False,
        function: Callable[..., Tensor] | None = None,
        shape: tuple[int, ...] | None = None,
        touch: str | None = None,
    ) -> None:
        super().__init__()
        self.module = module
        self.layout = layout
        self.length = length
        self.n_classes = n_classes
        self.layer = layer
        self.last_linear = last_linear
        self.function = function
        self.shape = (n_classes,) if shape is None else tuple(shape)
        self.touch = touch

    @classmethod
    def probe(
        cls,
        module: nn.Module,
        layout: SensorLayout,
        x: Tensor,
        features: Features | None = None,
        *,
        extra: Mapping[str, Tensor] = MappingProxyType({}),
        touch: str | None = None,
        actions: bool = False,
    ) -> AnyModel:
        """Run a module on windows ``x [N, T, D]`` and wrap it.

        Args:
            module: the model.
            layout: the array.
            x: some windows; the first 3 are used.
            features: name of the layer whose output is the feature vector, or a function of
                (module, x [N, T, D]), and what else the module sees by name, that returns
                ``[N, p]``. None: the input of the last linear layer, if there is one.
            extra: what else it sees for these windows, ``[N, ...]`` each.
            touch: as for the class.
            actions: the outputs may have any shape ``[N, ...]``.

        Raises:
            ValueError: the forward pass fails, its output is not ``[N, n]`` or ``[N, ...]``, a
                policy does not see touch, or the named features cannot be found.
        """
        wrapped = cls(module, layout, x.shape[1], 1, touch=touch)
        device = device_of(module)
        x = x[:_PROBE].to(device)
        others = {key: values[:_PROBE].to(device) for key, values in extra.items()}
        linear = {of: at for at, of in module.named_modules() if isinstance(of, nn.Linear)}
        used: list[Any] = []
        hooks = [of.register_forward_hook(lambda of, *_: used.append(of)) for of in linear]
        try:
            outputs = wrapped._outputs(x, others, actions)
        finally:
            for hook in hooks:
                hook.remove()
        wrapped.shape = tuple(outputs.shape[1:])
        wrapped.n_classes = math.prod(wrapped.shape)
        if others or len(wrapped.shape) > 1:
            wrapped._check_touch(x, others, outputs)
        if isinstance(features, str):
            wrapped.layer = features
        elif features is not None:
            wrapped.function = features
        elif used:
            wrapped.layer = linear[used[-1]]
            wrapped.last_linear = True
        wrapped._check_features(x, others, features)
        return wrapped

    @property
    def _name(self) -> str:
        return type(self.module).__name__

    def _outputs(self, x: Tensor, extra: Mapping[str, Tensor], actions: bool) -> Tensor:
        """Run the module once, and refuse outputs that are none."""
        shape = list(x.shape)
        try:
            with evaluating(self.module):
                outputs = self.call(x, extra)
        except Exception as error:  # a model may raise anything
            raise ValueError(
                f"{self._name} fails on windows of shape {shape}{_and(extra)}:"
                f" {first_line(error)}; an adapter needs a module from [N, T, D] to [N, n], so wrap"
                " one that takes another shape"
            ) from None
        fits = isinstance(outputs, Tensor) and len(outputs) == len(x)
        if not fits or outputs.dim() < 2 or (outputs.dim() > 2 and not actions):
            expected = "..." if actions else "n"
            raise ValueError(
                f"{self._name} returns {_shape(outputs)} for windows of shape {shape}: expected"
                f" [{len(x)}, {expected}]"
            )
        if not torch.isfinite(outputs).all():
            raise ValueError(
                f"{self._name} returns NaN or infinity for finite windows: give a model with finite"
                " weights"
            )
        return outputs

    def _check_touch(self, x: Tensor, extra: Mapping[str, Tensor], outputs: Tensor) -> None:
        """Refuse a policy whose actions are the same whatever the cells read."""
        with evaluating(self.module):
            if torch.equal(self.call(1.0 - x, extra), outputs):
                raise ValueError(
                    f"{self._name} does not use touch: its actions stay the same"
                    " whatever the cells read, so there is nothing to repair"
                )

    def _check_features(
        self, x: Tensor, extra: Mapping[str, Tensor], given: Features | None
    ) -> None:
        """Run the features once. What was found without being named is dropped if it is
        unusable."""
        if self.layer is None and self.function is None:
            return
        try:
            with evaluating(self):
                found: Any = self.features(x, **extra)
            if isinstance(found, Tensor) and found.dim() == 2 and len(found) == len(x):
                return
            problem = _shape(found)
        except Exception as error:
            problem = first_line(error)
        if given is not None:
            layers = [at for at, _ in self.module.named_modules() if at]
            if not isinstance(given, str):
                given = getattr(given, "__name__", type(given).__name__)
            raise ValueError(
                f"the features {given!r} of {self._name} are not [{len(x)}, p] for {len(x)}"
                f" windows: {problem}; name one of its layers"
                f" ({', '.join(layers[:8])}{', ...' if len(layers) > 8 else ''})"
            )
        self.layer = None
        self.last_linear = False

    @property
    def has_features(self) -> bool:
        """Whether :meth:`features` can be computed."""
        return self.layer is not None or self.function is not None

    @property
    def head(self) -> nn.Linear | None:
        """The last linear layer, if its output is the output of the model."""
        if not self.last_linear or self.layer is None:
            return None
        layer = self.module.get_submodule(self.layer)
        return (
            layer if isinstance(layer, nn.Linear) and layer.out_features == self.n_classes else None
        )

    def call(self, x: Tensor, extra: Mapping[str, Tensor]) -> Tensor:
        """Return what the module itself returns for windows ``[N, T, D]`` and what else it sees."""
        outputs: Tensor = (
            self.module(x, **extra) if self.touch is None else self.module({self.touch: x, **extra})
        )
        return outputs

    def features(self, x: Tensor, /, **extra: Tensor) -> Tensor:
        """Map windows ``[N, T, D]``, and what else the module sees, to features ``[N, p]``.

        Features of each frame are averaged over time; those of each step of the actions lie side by
        side.
        """
        if self.function is not None:
            return self.function(self.module, x, **extra)
        if self.layer is None:
            raise ValueError(f"{self._name} has no features: name a layer with features=")
        seen: list[Any] = []
        layer = self.module.get_submodule(self.layer)
        if self.last_linear:
            hook = layer.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
        else:
            hook = layer.register_forward_hook(lambda _, __, output: seen.append(output))
        try:
            self.call(x, extra)
        finally:
            hook.remove()
        if not seen:
            raise ValueError(f"the layer {self.layer!r} does not run in the forward pass")
        # recurrent layers return tuples
        values: Tensor = seen[-1][0] if isinstance(seen[-1], tuple) else seen[-1]
        if values.dim() < 3:
            return values
        if len(self.shape) > 1 and values.shape[1:-1] == self.shape[:-1]:
            return values.flatten(1)
        return values.flatten(1, -2).mean(1)

    def forward(self, x: Tensor, /, **extra: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` on the 0..1 scale, and what else the module sees, to outputs
        ``[N, n]``."""
        return self.call(x, extra).flatten(1)

    @property
    def config(self) -> dict[str, Any]:
        """Arguments of :meth:`from_config`; JSON-safe."""
        kind = type(self.module)
        return {
            "module": f"{kind.__module__}.{kind.__qualname__}",
            "builder": builder_of(self.module),
            "layout": self.layout.to_dict(),
            "length": self.length,
            "n_classes": self.n_classes,
            "layer": self.layer,
            "last_linear": self.last_linear,
            "shape": list(self.shape),
            "touch": self.touch,
        }

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], module: nn.Module | None = None, function: Any = None
    ) -> AnyModel:
        """Wrap ``module``, an instance of the class that ``config["module"]`` names; None: from its
        builder.

        Raises:
            ValueError: there is neither a module nor an allowed builder.
        """
        layout = SensorLayout.from_dict(config["layout"])
        if module is None and config.get("builder") is None:
            raise ModelNotAllowed(
                f"the model is a {config['module']}: give an instance of it as network="
            )
        if module is None:
            module = build_model(
                config["builder"], layout, config["n_classes"], length=config["length"]
            )
        return cls(
            module,
            layout,
            config["length"],
            config["n_classes"],
            layer=config["layer"],
            last_linear=config["last_linear"],
            function=function,
            shape=config.get("shape"),
            touch=config.get("touch"),
        )

    def fresh(self, seed: int) -> AnyModel:
        """Return a copy with new initial weights; frozen parameters stay as they are.

        Raises:
            ValueError: a trainable parameter belongs to a layer without ``reset_parameters``.
        """
        if kinds := not_resettable(self.module):
            raise ValueError(
                f"{self._name} cannot be trained anew: {', '.join(kinds)} has"
                " parameters but no reset_parameters()"
            )
        copied = copy.deepcopy(self)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            for layer in copied.modules():
                if _trainable(layer):
                    reset: Any = getattr(layer, "reset_parameters", None) or layer._reset_parameters
                    reset()
        return copied


def network_from_config(
    config: Mapping[str, Any], module: nn.Module | None = None, function: Any = None
) -> TactileTransformer | AnyModel:
    """Build a network, without its weights, from the ``config`` of either class; see
    :meth:`AnyModel.from_config`."""
    if "module" not in config:
        return TactileTransformer.from_config(config)
    return AnyModel.from_config(config, module, function)


def not_resettable(module: nn.Module) -> list[str]:
    """Return the classes of layers that hold trainable parameters and cannot draw new initial
    weights."""
    lacking = (
        type(layer).__name__
        for layer in module.modules()
        if _trainable(layer)
        and not hasattr(layer, "reset_parameters")
        and not hasattr(layer, "_reset_parameters")
    )
    return list(dict.fromkeys(lacking))


def _and(extra: Mapping[str, Tensor]) -> str:
    """Return what a module sees beside touch, for a message."""
    shapes = (f"{name} {list(values.shape)}" for name, values in extra.items())
    return "".join(f", {shape}" for shape in shapes)


def _shape(found: Any) -> str:
    """Return the shape of a tensor, or the type of what is none, for a message."""
    return str(list(found.shape)) if isinstance(found, Tensor) else type(found).__name__


def device_of(module: nn.Module) -> torch.device:
    """Return the device of the first parameter; the CPU for a module without parameters."""
    return next((p.device for p in module.parameters()), torch.device("cpu"))


def _trainable(layer: nn.Module) -> bool:
    return any(p.requires_grad for p in layer.parameters(recurse=False))
