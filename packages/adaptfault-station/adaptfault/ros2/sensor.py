"""The sensor that the parameters of the node name. Needs no ROS."""

from __future__ import annotations

from dataclasses import replace

from adaptfault.acquisition.followed import BundleAt, Sensor
from adaptfault.data.recordings import parse_shape, read_layout
from adaptfault.data.recordings.facts.layout_file import looks_like_shape
from adaptfault.ros2.parameters import Parameters
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

_STATED = ("full_scale", "unit", "rate")


def sensor_of(parameters: Parameters, before: Sensor | None = None) -> Sensor:
    """Return the sensor of the bundle, or of the layout.

    Args:
        parameters: of the node.
        before: as it was read before; what did not change is not loaded again.

    Raises:
        ValueError: neither bundle nor layout, or both; a bundle that is damaged, not signed by the
            trusted key, or now of another array.
        OSError: bundle or layout cannot be read.
    """
    if bool(parameters.bundle) == bool(parameters.layout):
        raise ValueError(
            "give the parameter bundle, or the parameter layout (a layout file or a shape as"
            " 2x11x10)"
        )
    stated = {name: getattr(parameters, name) for name in _STATED if getattr(parameters, name)}
    if parameters.bundle:
        if stated:
            raise ValueError(f"the bundle states {' and '.join(stated)}; leave the parameter out")
        keys = [parameters.trust] if parameters.trust else None
        return BundleAt(parameters.bundle, keys, bool(parameters.restored)).sensor(before)
    text = parameters.layout
    layout = SensorLayout(*parse_shape(text)) if looks_like_shape(text) else read_layout(text)
    layout = replace(layout, **stated)
    return Sensor(SelfDiagnosis(layout), FaultSet((), layout.n_cells))
