"""What is inferred of an array is written down once, with its reasons, and stated from then on."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import load, read_layout
from adaptfault.data.recordings.facts.layout_file import write_layout
from diagnostics import SensorLayout


def test_what_was_inferred_is_written_with_its_reasons_and_then_stated(tmp_path, capsys):
    folder = tmp_path / "today"
    folder.mkdir()
    rng = np.random.default_rng(0)
    stamps = np.floor(1000 * np.arange(80) / 120)
    for i in range(3):
        values = rng.integers(0, 900, (80, 12))
        rows = [",".join(map(str, row)) for row in np.column_stack([stamps.astype(int), values])]
        header = ",".join(["time", *(f"cell{c}" for c in range(12))])
        (folder / f"{i}.csv").write_text("\n".join([header, *rows]) + "\n")
    layout = tmp_path / "layout.toml"
    assert main(["info", str(folder), "--shape", "3x4", "--write-layout", str(layout)]) == 0
    capsys.readouterr()
    comments = [line for line in layout.read_text().splitlines() if line.startswith("# inferred")]
    assert len(comments) == 2
    assert any("full scale 1023 count (whole numbers" in line for line in comments)
    assert any("rate 120 Hz (time column of 0.csv and 2 more)" in line for line in comments)
    loaded = load(folder, layout=layout)
    assert loaded.inferred == ()
    assert loaded.recordings.layout == SensorLayout(
        1, 3, 4, full_scale=1023, unit="count", rate=120
    )


@settings(max_examples=30, deadline=None)
@given(
    sizes=st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 4)),
    full_scale=st.floats(0.1, 65535),
    unit=st.text(st.characters().filter(str.isprintable), min_size=1, max_size=5),
    seed=st.integers(0, 99),
    name=st.none() | st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=5),
)
def test_every_layout_is_read_as_it_was_written(
    tmp_path_factory, sizes, full_scale, unit, seed, name
):
    present = np.random.default_rng(seed).random(sizes) < 0.7
    present[0, 0, 0] = True
    cells = np.flatnonzero(present)
    groups = None if name is None else {name: cells[::2].tolist()}
    layout = SensorLayout(*sizes, full_scale=full_scale, unit=unit, present=present, groups=groups)
    path = tmp_path_factory.mktemp("layout") / "layout.toml"
    write_layout(path, layout, ["a reason\nof two lines"])
    assert read_layout(path) == layout
