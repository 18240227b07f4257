"""Results fit on a line at a prompt, and show their text in a notebook."""

import numpy as np
import pytest

import adaptfault as af
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout
from diagnostics.shown import shown


def test_results_have_a_line_and_a_page(grasps):
    windows = af.make_windows(grasps.frames[::20], grasps.labels[::20], grasps.layout)
    diagnosis = SelfDiagnosis(SensorLayout(1, 2, 3)).diagnose(np.zeros((40, 6)))
    expected = {"fault-free": windows.y}
    forecast = af.Forecast.of(FaultSet((), 220), windows.y, windows.recording, expected)
    scores = af.Scores.of(windows.y, windows.y, n_classes=7)
    for result in (grasps, windows, diagnosis, diagnosis.coverage, forecast, scores):
        line = repr(result)
        assert line.startswith(f"<{type(result).__name__}: ")
        assert len(line) <= 160
        assert "\n" not in line
        page = result._repr_html_()
        assert page.startswith("<pre>")
        assert page.count("<") == 2  # nothing in the text is taken for HTML


def test_a_class_without_a_text_is_refused():
    with pytest.raises(TypeError, match="has no text"):
        shown(type("Nothing", (), {}))
