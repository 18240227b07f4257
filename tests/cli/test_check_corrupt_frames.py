"""A corrupt frame changes nothing else that a check says of a data set."""

import json
from pathlib import Path

import numpy as np

from adaptfault.cli import main


def lying(folder: Path, corrupt: bool) -> Path:
    """Write recordings of somebody who lies still on a mat of 16 x 8; one frame of each may have
    its bytes exchanged."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    y, x = np.mgrid[:16, :8]
    for k in range(3):
        body = 700 * np.exp(-((y - 6) ** 2 / 10 + (x - 4 + rng.normal(0, 0.3)) ** 2 / 4))
        breath = 1 + 0.03 * np.sin(np.arange(40) / 7)[:, None, None]
        frames = np.rint(body * breath + rng.gamma(0.4, 1.2, (40, 16, 8))).astype("<u2")
        if corrupt:
            frames[1] = frames[1].byteswap() & 4095
        np.savetxt(folder / f"{k}.csv", frames.reshape(40, -1), fmt="%d", delimiter=",")
    return folder


def checked(folder: Path, capsys) -> dict:
    main(["check", str(folder), "--shape", "16x8", "--rate", "10", "--json", "--quiet"])
    return json.loads(capsys.readouterr().out)


def test_a_corrupt_frame_is_named_and_range_coverage_and_tare_are_as_without_it(tmp_path, capsys):
    plain = checked(lying(tmp_path / "plain", corrupt=False), capsys)
    broken = checked(lying(tmp_path / "broken", corrupt=True), capsys)
    names = [finding["name"] for finding in broken["inspection"]["findings"]]
    assert "corrupt_frame" in names
    assert broken["summary"]["layout"]["full_scale"] == plain["summary"]["layout"]["full_scale"]
    assert broken["remarks"] == plain["remarks"]
    coverage = broken["inspection"]["diagnosis"]["coverage"]
    assert coverage["untested"] == plain["inspection"]["diagnosis"]["coverage"]["untested"]
