"""Documents are as their JSON Schemas say, and what is not is refused."""

import json

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.schemas import SCHEMAS, schema_of
from diagnostics import Diagnosis, Fault, Line, SensorLayout


def validate(document):
    schema = schema_of(document["schema"])
    jsonschema.Draft202012Validator(schema).validate(document)


@pytest.mark.parametrize("name", SCHEMAS)
def test_each_schema_is_one_and_asks_for_what_its_name_says(name):
    schema = schema_of(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["properties"]["schema"] == {"const": name}
    assert not jsonschema.Draft202012Validator(schema).is_valid({"schema": "other/1"})


layouts = st.builds(
    SensorLayout,
    st.integers(1, 3),
    st.integers(1, 4),
    st.integers(1, 4),
    full_scale=st.floats(0.1, 1e6),
    unit=st.text("Nmk", min_size=1, max_size=3),
    rate=st.floats(0.1, 1e4),
    wiring=st.sampled_from(["matrix", "bus"]),
)


@given(layouts, st.data())
def test_layouts_and_diagnoses_are_as_their_schemas_say(layout, data):
    validate(layout.to_dict())
    cells = data.draw(st.sets(st.integers(0, layout.n_cells - 1), max_size=3))
    kinds = data.draw(st.sampled_from(["open", "stuck", "late"]))
    line = data.draw(st.sampled_from([None, Line(0, "row", 0)]))
    recordings = data.draw(st.sampled_from([None, (0, 2)]))
    faults = ()
    if cells:
        about = {"line": line, "probability": 0.9, "onset": 3, "recordings": recordings}
        faults = (Fault(kinds, tuple(cells), reason="it is", **about),)
    diagnosis = Diagnosis(
        layout, faults, np.full(layout.n_cells, 0.5), np.zeros(layout.n_cells, bool), 30, 3
    )
    document = diagnosis.to_dict()
    validate(document)
    for name in document:
        without = {key: value for key, value in document.items() if key != name}
        schema = schema_of("adaptfault.diagnosis/1")
        assert not jsonschema.Draft202012Validator(schema).is_valid(without)


def test_what_info_and_diagnose_write_is_as_the_schemas_say(tmp_path, capsys):
    layout = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
    rng = np.random.default_rng(0)
    frames = [rng.uniform(0, 0.8, (40, 12)).astype(np.float32) for _ in range(4)]
    frames[0][3, 2] = np.nan
    save_npz(tmp_path / "log.npz", Recordings(tuple(frames), layout))
    log = str(tmp_path / "log.npz")
    assert main(["info", log, "--json", "-q"]) == 0
    validate(json.loads(capsys.readouterr().out))
    out = tmp_path / "diagnosis.json"
    main(["diagnose", log, "--out", str(out), "--json", "-q"])
    validate(json.loads(out.read_text()))
    validate(json.loads(capsys.readouterr().out))
