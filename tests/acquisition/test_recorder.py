"""The recorder: what was written can be loaded, whenever the power goes."""

import json
import os
import signal
import subprocess
import sys
from datetime import datetime

import numpy as np
import pytest

from adaptfault.acquisition import Contact, Recorder, Switch, parse_when
from adaptfault.acquisition import recorder as recorder_module
from adaptfault.data.recordings import load
from diagnostics import SensorLayout

SMALL = SensorLayout(1, 2, 3, full_scale=4095, unit="count", rate=10.0)
NONE = np.zeros(6, bool)
NOON = datetime(2025, 5, 1, 12, 0)
rng = np.random.default_rng(0)


def counts(frames=40):
    return rng.integers(0, 4096, (frames, 6)).astype(float)


def again(folder):
    return load(folder, layout=folder / "layout.json")


def test_what_is_recorded_is_loaded_as_it_was_with_its_layout(tmp_path):
    values = counts()
    values[3, 2] = np.nan
    with Recorder(tmp_path / "new" / "log", SMALL, "A4:CF") as recorder:
        for i, frame in enumerate(values):
            assert recorder.write(frame, i / 10) is None
        recorded = recorder.close()
    assert (recorded.frames, recorded.seconds) == (40, pytest.approx(4.0))
    assert str(recorded).endswith(": 40 frames, 4.0 s")
    loaded = again(tmp_path / "new" / "log").recordings
    assert loaded.layout == SMALL
    np.testing.assert_array_equal(loaded.frames[0], values.astype(np.float32))
    assert recorded.path.name.startswith("A4-CF_")


def test_newtons_are_recorded_as_exactly_as_they_are_kept(tmp_path):
    values = rng.uniform(0, 5, (20, 220)).astype(np.float32)
    with Recorder(tmp_path, SensorLayout.paper()) as recorder:
        for i, frame in enumerate(values):
            recorder.write(frame, i / 10)
    np.testing.assert_array_equal(load(tmp_path).recordings.frames[0], values)


def test_lost_frames_become_missing_readings_and_a_pause_begins_a_new_file(tmp_path):
    values = counts(4)
    with Recorder(tmp_path, SMALL) as recorder:
        recorder.write(values[0], 0.0)
        recorder.write(values[1], 0.4)
        ended = recorder.write(values[2], 9.0)
        assert (ended.frames, recorder.path != ended.path) == (5, True)
        recorder.write(values[3], 9.1)
    first, second = again(tmp_path).recordings.frames
    assert np.isnan(first).all(axis=1).tolist() == [False, True, True, True, False]
    np.testing.assert_array_equal(second, values[2:])


def test_a_long_recording_goes_on_in_a_new_file_and_no_frame_is_lost(tmp_path):
    values = counts(100)
    with Recorder(tmp_path, SMALL, longest=3.0) as recorder:
        for i, frame in enumerate(values):
            recorder.write(frame, i / 10)
    frames = again(tmp_path).recordings.frames
    assert [len(one) for one in frames] == [31, 31, 31, 7]
    np.testing.assert_array_equal(np.concatenate(frames), values)


def test_each_frame_is_with_the_system_at_once_and_on_the_disk_within_the_interval(
    tmp_path, monkeypatch
):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    now = [100.0]
    monkeypatch.setattr(recorder_module.time, "monotonic", lambda: now[0])
    with Recorder(tmp_path, SMALL, interval=0.05) as recorder:
        for i in range(20):
            recorder.write(np.full(6, i), i / 10)
            assert recorder.path.read_text().count("\n") == i + 1
            recorder._syncing.result()  # its thread is as quick as its disk
            if i == 0:
                synced.clear()
            now[0] += 0.01
        before_close = len(synced)
    assert before_close == 3
    assert (
        synced[-1]
        == recorder.folder.joinpath(next(p.name for p in tmp_path.glob("*.csv"))).stat().st_size
    )


def test_a_recorder_that_was_killed_leaves_a_recording_that_can_be_read(tmp_path):
    code = (
        "import sys, time, numpy as np\n"
        "from adaptfault.acquisition import Recorder\n"
        "from diagnostics import SensorLayout\n"
        "recorder = Recorder(sys.argv[1], SensorLayout(1, 2, 3, full_scale=4095, unit='count'))\n"
        "for i in range(10**6):\n"
        "    recorder.write(np.full(6, i % 4000), i / 10)\n"
        "    i == 200 and print('going', flush=True)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    child.stdout.readline()
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    frames = np.concatenate(again(tmp_path).recordings.frames)
    assert len(frames) >= 200
    np.testing.assert_array_equal(frames[:, 0], np.arange(len(frames)) % 4000)


def test_a_disk_that_is_full_at_the_start_may_have_room_later(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with Recorder(tmp_path, SMALL) as recorder:
        with pytest.raises(OSError, match="No space left"):
            recorder.write(np.zeros(6), 0.0)
        monkeypatch.undo()
        recorder.write(np.ones(6), 5.0)
    assert [len(one) for one in again(tmp_path).recordings.frames] == [1]


def test_a_full_disk_is_an_os_error_and_what_was_written_stays(tmp_path, monkeypatch):
    with Recorder(tmp_path, SMALL) as recorder:
        recorder.write(np.zeros(6), 0.0)

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            recorder.close()
        monkeypatch.undo()
        assert recorder.path is None
        recorder.write(np.ones(6), 5.0)  # and it can go on
    assert [len(one) for one in again(tmp_path).recordings.frames] == [1, 1]


def test_a_folder_of_another_array_and_a_frame_of_another_size_are_refused(tmp_path):
    with (
        Recorder(tmp_path, SMALL) as recorder,
        pytest.raises(ValueError, match="expected a frame of 6 readings"),
    ):
        recorder.write(np.zeros(7), 0.0)
    assert json.loads((tmp_path / "layout.json").read_text())["schema"] == "adaptfault.layout/1"
    with pytest.raises(ValueError, match="record into another folder"):
        Recorder(tmp_path, SensorLayout.paper())


def test_files_never_overwrite_each_other(tmp_path):
    for _ in range(3):
        with Recorder(tmp_path, SMALL) as recorder:
            recorder.write(np.zeros(6), 0.0)
    assert len(list(tmp_path.glob("*.csv"))) == 3


# When to record


def test_contact_counts_trusted_cells_and_lasts_a_second_longer():
    switch = Switch(parse_when("contact", SMALL))
    touched = np.array([900.0, 800, 700, 0, 0, 0])
    rest = np.zeros(6)
    assert not switch(rest, NONE, 0.0, NOON)
    assert switch(touched, NONE, 1.0, NOON)
    assert switch(rest, NONE, 1.9, NOON)
    assert not switch(rest, NONE, 2.1, NOON)
    broken = np.array([True, False, False, False, False, False])
    assert not switch(touched, broken, 3.0, NOON)
    assert not switch(np.full(6, np.nan), NONE, 4.0, NOON)


def test_a_threshold_can_be_given_and_small_arrays_need_fewer_cells():
    assert parse_when("contact:100", SMALL) == Contact(100.0, 3)
    assert parse_when("contact", SensorLayout(1, 1, 2)) == Contact(0.25, 2)


@pytest.mark.parametrize(
    ("hours", "inside", "outside"),
    [("08:00-17:30", (8, 0), (17, 30)), ("22:00-6:15", (6, 14), (21, 59))],
)
def test_hours_are_local_time_and_may_span_midnight(hours, inside, outside):
    switch = Switch(parse_when(hours, SMALL))
    for (hour, minute), expected in ((inside, True), (outside, False)):
        assert switch(np.zeros(6), NONE, 0.0, NOON.replace(hour=hour, minute=minute)) is expected


def test_a_command_goes_before_the_rule_until_it_is_taken_back():
    for text, by_rule in (("always", True), ("command", False)):
        switch = Switch(parse_when(text, SMALL))
        for command, expected in ((None, by_rule), (True, True), (False, False), (None, by_rule)):
            switch.command = command
            assert switch(np.zeros(6), NONE, 0.0, NOON) is expected


@pytest.mark.parametrize(
    "text", ["", "sometimes", "contact:x", "contact:-1", "contact:5000", "25:00-26:00", "8-17"]
)
def test_a_rule_that_is_none_is_refused_with_what_there_is(text):
    with pytest.raises(ValueError, match=r"--when .*expected"):
        parse_when(text, SMALL)
