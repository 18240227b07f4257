"""adaptfault predict: one prediction a recording, with layout, scale and class names of the
model."""

import json
from dataclasses import replace

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.windows import make_windows
from adaptfault.evaluation.scores import of_recording
from adaptfault.prediction.predictor import Predictor
from diagnostics import FaultSet


def test_each_recording_has_the_class_that_evaluate_gives_it(
    made_bundle, small_grasps, tmp_path, capsys
):
    some = small_grasps.select(range(0, 90, 6))
    short = Recordings(
        (*some.frames, some.frames[0][:4]), some.layout, names=(*some.names, "short")
    )
    save_npz(tmp_path / "today.npz", short)
    assert (
        main(
            [
                "predict",
                str(tmp_path / "today.npz"),
                "--bundle",
                str(made_bundle),
                "--json",
                "--quiet",
            ]
        )
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    *whole, last = result["predictions"]
    assert (last["class"], last["probability"], last["windows"]) == (None, None, 0)
    windows = make_windows(some.frames, None, some.layout)
    probabilities = Predictor.load(made_bundle).predict_proba(windows.x)
    for i, one in enumerate(whole):
        own = probabilities[windows.recording == i].astype(float)
        whole_one = of_recording(own)
        assert one["class"] == result["class_names"][own.prod(axis=0).argmax()]
        assert one["probability"] == pytest.approx(whole_one.max(), abs=1e-3)
        assert one["windows"] == 6


def test_the_table_names_recordings_classes_and_labels(made_bundle, small_grasps, tmp_path, capsys):
    save_npz(tmp_path / "today.npz", small_grasps.select(range(0, 90, 10)))
    assert (
        main(["predict", str(tmp_path / "today.npz"), "--bundle", str(made_bundle), "--quiet"]) == 0
    )
    head, *rows, total = capsys.readouterr().out.splitlines()
    assert head.split() == ["recording", "class", "P", "windows", "that", "agree", "label"]
    assert len(rows) == 9
    right = sum(row.split()[-1] == row.split()[-6] for row in rows)
    assert total == f"{right} of 9 recordings are predicted as labelled"


def test_evaluate_and_predict_put_exchanged_wires_back_as_the_version_that_the_bundle_runs(
    bundle, made_bundle, small_grasps, tmp_path, capsys
):
    some = small_grasps.select(range(0, 90, 6))
    save_npz(tmp_path / "before.npz", some)
    wired = np.random.default_rng(0).permutation(bundle.layout.n_cells)
    save_npz(
        tmp_path / "after.npz",
        replace(some, frames=tuple(frames[:, wired] for frames in some.frames)),
    )
    healthy = bundle.parts.adapter().adapt(FaultSet((), wired.size), method="fill")
    bundle.deploy(bundle.write_version(healthy, {"source": np.argsort(wired).tolist()}).number)

    def told(*words) -> dict:
        assert main([*map(str, words), "--json", "--quiet"]) == 0
        return json.loads(capsys.readouterr().out)

    before = tmp_path / "before.npz"
    after = tmp_path / "after.npz"
    for inject in ([], ["--inject", "row:0:3=open"]):
        scores = [
            told("evaluate", which, path, "--all", "--head", "linear", *inject)["scores"]
            for which, path in ((made_bundle, before), (bundle.path, after))
        ]
        assert scores[0] == scores[1]
    assert told("evaluate", made_bundle, after, "--all", "--head", "linear")["scores"] != scores[0]
    plain = told("predict", before, "--bundle", made_bundle)
    rewired = told("predict", after, "--bundle", bundle.path)
    assert [one["class"] for one in plain["predictions"]] == [
        one["class"] for one in rewired["predictions"]
    ]


def test_recordings_that_contradict_the_model_are_refused_in_one_line(
    made_bundle, tmp_path, capsys
):
    np.savez(tmp_path / "other.npz", frames=np.zeros((3, 20, 1, 4, 4)))
    assert main(["predict", str(tmp_path / "other.npz"), "--bundle", str(made_bundle)]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(SystemExit) as end:
        main(["predict", str(tmp_path / "other.npz")])
    assert end.value.code == 3
    assert "one of the arguments --model --bundle is required" in capsys.readouterr().err
