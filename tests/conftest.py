"""What several test modules use: simulated grasps, what is trained or fitted once, a clock."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from fits import made_once_each

from adaptfault.bundle.bundle import Bundle
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.models import forest
from adaptfault.models.store import save_model
from diagnostics import Fault, FaultSet, Line, SelfDiagnosis, SensorLayout, inject, line_fault
from diagnostics.model import fitting, predictor

_TREES = forest.TREES
_STEPS = predictor._STEPS
_LOGS = fitting._LOGS
_WITH_TREES = ("forest", "targets")

# The same few examples on every machine.
hypothesis.settings.register_profile(
    "few", derandomize=True, database=None, deadline=None, max_examples=30, print_blob=False
)
hypothesis.settings.load_profile("few")


@pytest.hookimpl(trylast=True)  # after the choice of tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put what needs a costly fixture together, so that the processes of ``pytest -n 2`` neither
    wait for each other nor make the fixtures of a module twice.

    Each process gets one half: the first begins with the fitted diagnosis, the second with the
    bundle. Tests that share nothing end each half: an idle process takes them over from there.
    """
    parts: dict[str, list[pytest.Item]] = {
        "fitted": [],
        "made_bundle": [],
        "versions": [],
        "graph": [],
        "of a module": [],
        "": [],
    }
    for item in items:
        names = getattr(item, "fixturenames", ())
        costly = next((name for name in parts if name in names), "")
        if not costly and shares_with_its_module(item):
            costly = "of a module"
        parts[costly].append(item)
    fitted, bundle, versions, graph, of_module, others = parts.values()
    first = [*fitted, *of_module]
    rest = max(0, len(items) // 2 - len(first))
    items[:] = [*first, *others[:rest], *bundle, *versions, *graph, *others[rest:]]


def shares_with_its_module(item: pytest.Item) -> bool:
    """Return whether a test has a fixture of the scope of a module."""
    fixtures = getattr(item, "_fixtureinfo", None)
    if fixtures is None:
        return False
    return any(made[-1].scope == "module" for made in fixtures.name2fixturedefs.values())


@pytest.fixture(scope="session")
def grasps() -> Recordings:
    """140 simulated grasps of the paper's task, 20 a class."""
    return simulate(20, seed=3)


@pytest.fixture(scope="session")
def made_once(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, Callable[[Path], object]], Path]:
    """Return a folder that ``make`` fills, once for all processes of ``pytest -n``."""
    home = tmp_path_factory.getbasetemp()

    def made_once(name: str, make: Callable[[Path], object]) -> Path:
        if "PYTEST_XDIST_WORKER" not in os.environ:
            if not (home / name).exists():
                (home / name).mkdir()
                make(home / name)
            return home / name
        from filelock import FileLock

        place = home.parent / name
        made = home.parent / f"{name}.made"
        with FileLock(f"{place}.lock"):
            if not made.exists():
                shutil.rmtree(place, ignore_errors=True)
                place.mkdir()
                make(place)
                made.touch()
        return place

    return made_once


@pytest.fixture(scope="session")
def fitted(grasps: Recordings, made_once) -> SelfDiagnosis:
    """Fitted with all steps to every other of the simulated grasps; test_serialization.py proves
    that files lose nothing of it."""

    def make(folder: Path) -> None:
        with whole_fit():
            SelfDiagnosis(grasps.layout).fit(grasps.frames[::2]).save(folder / "fitted.npz")

    return SelfDiagnosis.load(made_once("fitted", make) / "fitted.npz")


@pytest.fixture(scope="session")
def few_cells() -> Recordings:
    """140 simulated grasps of the small array, 100 frames each: a diagnosis of it costs a third."""
    return simulate(20, SIMULATED, seed=3)


@pytest.fixture(scope="session")
def fitted_few(few_cells: Recordings) -> SelfDiagnosis:
    """Fitted to every other of the grasps of the small array."""
    return SelfDiagnosis(SIMULATED).fit(few_cells.frames[::2])


@pytest.fixture(scope="session")
def pressed(made_once) -> SelfDiagnosis:
    """Fitted with all steps to 80 recordings of presses; see pressed_recordings.py."""
    from pressed_recordings import LAYOUT, presses

    def make(folder: Path) -> None:
        with whole_fit():
            SelfDiagnosis(LAYOUT).fit(presses(0, 80)).save(folder / "fitted.npz")

    return SelfDiagnosis.load(made_once("pressed", make) / "fitted.npz")


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Threads cost more than they bring on small models."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def once_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[Callable[[int], object]], threading.Thread]:
    """Return what has ``send(port)`` called in a thread of its own as soon as a receiver has bound
    its port.

    What is sent before is lost, and a command that counts frames would wait for them without end.
    """
    from adaptfault.acquisition.receiver import Receiver

    begin = Receiver.__aenter__

    def once_bound(send: Callable[[int], object]) -> threading.Thread:
        ports: list[int] = []
        sending = threading.Thread(target=lambda: send(ports[0]))

        async def begin_and_send(receiver: Receiver) -> Receiver:
            await begin(receiver)
            ports.append(receiver.port)
            sending.start()
            return receiver

        monkeypatch.setattr(Receiver, "__aenter__", begin_and_send)
        return sending

    return once_bound


SMALL = SensorLayout(2, 3, 3, full_scale=4.0, present=np.arange(18) != 4)
DROPPED = {"whole": (), "head": (1, 9, 17)}


def small_windows(n: int, seed: int = 0) -> np.ndarray:
    """Windows of 5 frames of the small array, half of the cells untouched; nothing where there is
    no cell."""
    rng = np.random.default_rng(seed)
    touched = (rng.random((n, 1, 18)) < 0.5) & SMALL.present.ravel()
    return np.where(touched, rng.random((n, 5, 18)), 0).astype(np.float32)


@pytest.fixture(scope="session")
def versions(made_once) -> dict[str, Path]:
    """Folders of two adaptations of one small network, with ONNX files: F empty, and one with all
    parts."""
    home = made_once("versions", export_versions)
    return {name: home / name for name in DROPPED}


@pytest.fixture(scope="session")
def small_graph(versions: dict[str, Path], made_once) -> bytes:
    """The ONNX graph of this network with any head in closed form."""

    def make(home: Path) -> None:
        from adaptfault.adaptation.result import Adaptation
        from adaptfault.prediction.export import graph_of

        network = Adaptation.load(versions["whole"]).model.network
        (home / "graph.onnx").write_bytes(graph_of(network))

    return (made_once("graph", make) / "graph.onnx").read_bytes()


def small_forest(course: Any) -> Any:
    """A forest that tells three classes by the order of the windows."""
    from adaptfault.models.forest import fit_forest

    classes = np.eye(3, dtype="f4")[np.arange(len(course)) % 3]
    return fit_forest(course.numpy(), classes, np.arange(20) % 5)[0]


def export_versions(home: Path) -> None:
    import torch

    from adaptfault.adaptation.reduced_model import ReducedModel, phi
    from adaptfault.adaptation.result import Adaptation, Stage
    from adaptfault.data.windows import Windows
    from adaptfault.imputation.statistics import CellStatistics
    from adaptfault.models.heads import Head
    from adaptfault.models.kernels import Kernels, Known
    from adaptfault.models.network import TactileTransformer
    from adaptfault.prediction.export import add_onnx

    network = TactileTransformer(SMALL, 3, length=5).eval()
    windows = Windows(small_windows(60), np.arange(60) % 3, np.arange(60))
    for name, cells in DROPPED.items():
        fault_set = FaultSet(cells, 18)
        front = None
        head = None
        if name == "head":
            front = CellStatistics.fit(windows).nearest(fault_set)
            with torch.no_grad():
                views = ReducedModel(network, fault_set, front).views(
                    torch.from_numpy(phi(windows.x, fault_set))
                )
            weights = torch.from_numpy(
                np.random.default_rng(1).normal(0, 3, (2, 60, 3)).astype("f4")
            )
            weights -= weights.mean(1, keepdim=True)  # no class is preferred everywhere
            known = Known(*views[:3])
            head = Head(
                known,
                widths=Kernels(known).widths,
                weights=weights,
                bias=torch.zeros(3),
                shares=torch.tensor([0.4, 0.6]),
                forest=small_forest(views.course),
                pooling=torch.tensor([0.9, 0.3]),
                units=torch.ones(known.moments.shape[1]),
                rest=torch.linspace(0, 0.1, 18),
            )
        model = ReducedModel(network, fault_set, front, head).eval()
        Adaptation(model, fault_set, (Stage("fill", 0.1),), _validation=windows).save(home / name)
        add_onnx(home / name)


@pytest.fixture
def seldom_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a monitor evaluate after every 96 frames, as it does on a larger array, where the frame
    that tells a fault is not what is proven: evaluations take most of its time."""
    monkeypatch.setattr("diagnostics.monitor.Monitor._pace", lambda monitor, pieces: (88, 96))


class Clock:
    """Stands in for the time module: its seconds pass only where a test lets them, however fast the
    machine is."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock that budgets go by in this test."""
    clock = Clock()
    for module in ("models.time_budget", "adaptation.stages", "models.training"):
        monkeypatch.setattr(f"adaptfault.{module}.time", clock)
    return clock


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


SIMULATED = SensorLayout(2, 6, 5)
SMALL_CLASSES = ("nothing", "softer", "harder")


@pytest.fixture(scope="session")
def small_grasps() -> Recordings:
    """90 simulated grasps of a small array, 30 a class."""
    return simulate(30, SIMULATED, n_frames=60, seed=1, classes=SMALL_CLASSES)


def write_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a pair of ed25519 keys; return the paths of the private and the public one."""
    from cryptography.hazmat.primitives import serialization as to
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    private = folder / f"{name}.pem"
    public = folder / f"{name}.public.pem"
    private.write_bytes(
        key.private_bytes(to.Encoding.PEM, to.PrivateFormat.PKCS8, to.NoEncryption())
    )
    public.write_bytes(
        key.public_key().public_bytes(to.Encoding.PEM, to.PublicFormat.SubjectPublicKeyInfo)
    )
    return private, public


@contextmanager
def without_export() -> Iterator[None]:
    """As where the export's packages are missing: it takes seconds, and has tests of its own."""
    pytest.importorskip("torch")

    def missing(*_: object, **__: object) -> None:
        raise ImportError("left out in this test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("adaptfault.prediction.export.add_onnx", missing)
        patch.setattr("adaptfault.prediction.export.graph_of", missing)
        yield


@pytest.fixture(scope="session", autouse=True)
def few_trees() -> Iterator[None]:
    """Let heads, and the check of rest levels, have fewer trees, which take most of their time; see
    ``all_trees``."""
    with pytest.MonkeyPatch.context() as patch:
        for module in _WITH_TREES:
            patch.setattr(f"adaptfault.models.{module}.TREES", 8)
        patch.setattr("adaptfault.evaluation.training_check._TREES", 8)
        yield


@pytest.fixture
def all_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let them have all their trees, where accuracy is what is proven."""
    for module in _WITH_TREES:
        monkeypatch.setattr(f"adaptfault.models.{module}.TREES", _TREES)
    monkeypatch.setattr("adaptfault.evaluation.training_check._TREES", 100)


@contextmanager
def fit_of(steps: int, logs: int) -> Iterator[None]:
    """Let a fit take so many steps and judge so many logs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("diagnostics.model.predictor._STEPS", steps)
        patch.setattr("diagnostics.model.fitting._LOGS", logs)
        yield


def whole_fit() -> AbstractContextManager[None]:
    """Let a fit take all its steps and judge all its logs, where its accuracy is what is proven."""
    return fit_of(_STEPS, _LOGS)


@pytest.fixture(scope="session", autouse=True)
def rough_fits() -> Iterator[None]:
    """Let a fit take fewer steps and judge fewer logs, which take most of its time; see
    ``wholly_fitted``."""
    with fit_of(100, 4):
        yield


@pytest.fixture(scope="session", autouse=True)
def each_made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let a fit to the same recordings, and an inspection of the same log, be made once; see
    ``fitted_anew``."""
    home = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        home = home.parent
    folder = home / "made_once"
    folder.mkdir(exist_ok=True)
    with made_once_each(folder):
        yield


@pytest.fixture
def fitted_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each fit be computed, where that is what is proven."""
    monkeypatch.setattr(SelfDiagnosis, "_fit", SelfDiagnosis._fit.__wrapped__)


@pytest.fixture
def wholly_fitted() -> Iterator[None]:
    with whole_fit():
        yield


@pytest.fixture(scope="session")
def made_bundle(small_grasps: Recordings, made_once) -> Path:
    """A bundle made by the command line; not to be changed."""

    def make(home: Path) -> None:
        save_npz(home / "grasps.npz", small_grasps)
        command = [
            "train",
            str(home / "grasps.npz"),
            "--out",
            str(home / "robot.bundle"),
            "--epochs",
            "5",
            "--quiet",
        ]
        with without_export():
            assert main(command) == 0

    return made_once("bundle", make) / "robot.bundle"


@pytest.fixture
def bundle(made_bundle: Path, tmp_path: Path) -> Iterator[Bundle]:
    """A copy of it, to be changed."""
    shutil.copytree(made_bundle, tmp_path / "robot.bundle")
    with without_export():
        yield Bundle.open(tmp_path / "robot.bundle")


VALUES = ("force", "row", "column")


def forces(frames: np.ndarray) -> np.ndarray:
    """Return the total force of each frame in mN, and its centre in rows and in thousandths of a
    column, ``[T, 3]``."""
    pads = frames.reshape(-1, *SIMULATED.shape)
    total = pads.sum((1, 2, 3))
    loaded = np.maximum(total, 1e-6)
    row = (pads.sum((1, 3)) * np.arange(6)).sum(1) / loaded
    column = (pads.sum((1, 2)) * np.arange(5)).sum(1) / loaded
    touched = total > 0.5
    return np.stack(
        [1000 * total, np.where(touched, row, 2.5), 1e-3 * np.where(touched, column, 2.0)], axis=1
    )


def write_forces(folder: Path, recordings: Sequence[np.ndarray]) -> None:
    """Write recordings of the small array as CSV files, and the table of the forces of their
    frames."""
    (folder / "grasps").mkdir(parents=True)
    (folder / "grasps" / "layout.json").write_text(json.dumps(SIMULATED.to_dict()))
    lines = [",".join(["file", "frame", *VALUES])]
    for i, frames in enumerate(recordings):
        np.savetxt(folder / "grasps" / f"{i:02d}.csv", frames, fmt="%.4f", delimiter=",")
        lines += [
            f"grasps/{i:02d}.csv,{t},{force:.2f},{row:.4f},{column:.7f}"
            for t, (force, row, column) in enumerate(forces(frames))
        ]
    (folder / "targets.csv").write_text("\n".join(lines))


@pytest.fixture(scope="session")
def forces_home(small_grasps: Recordings, made_once) -> Path:
    """Recordings with a table of their forces, a model of them and a bundle; not to be changed."""

    def make(home: Path) -> None:
        held = [
            f for f, label in zip(small_grasps.frames, small_grasps.labels, strict=True) if label
        ]
        write_forces(home, held)
        training = ["train", str(home / "grasps"), "--targets", str(home / "targets.csv")]
        training += ["--epochs", "8", "--learning-rate", "1e-3", "--quiet"]
        with without_export():
            assert main([*training, "--out", str(home / "robot.bundle")]) == 0
        bundled = Bundle.open(home / "robot.bundle").parts.adapter()
        save_model(
            home / "model",
            bundled.model,
            class_names=VALUES,
            extra={"split_seed": 0},
            head=bundled.healthy.model.head,
            task=bundled.task,
        )

    return made_once("forces", make)


@pytest.fixture
def forces_bundle(forces_home: Path, tmp_path: Path) -> Iterator[Bundle]:
    """A copy of the bundle of a regression, to be changed."""
    shutil.copytree(forces_home / "robot.bundle", tmp_path / "forces.bundle")
    with without_export():
        yield Bundle.open(tmp_path / "forces.bundle")


@pytest.fixture
def repaired(
    made_bundle: Path, later_grasps: list[np.ndarray], broken_row: Fault, made_once, tmp_path: Path
) -> Iterator[Bundle]:
    """A copy of it after maintenance with the broken row in 12 of the later grasps: version 2 is on
    probation."""

    def make(home: Path) -> None:
        from adaptfault.robot.maintenance import maintain

        shutil.copytree(made_bundle, home / "robot.bundle")
        log = [inject(frames, [broken_row], SIMULATED) for frames in later_grasps[:12]]
        assert maintain(Bundle.open(home / "robot.bundle"), log).decision == "deployed"

    with without_export():
        shutil.copytree(made_once("repaired", make) / "robot.bundle", tmp_path / "robot.bundle")
        yield Bundle.open(tmp_path / "robot.bundle")


@pytest.fixture
def linear_bundle(made_once) -> Iterator[Path]:
    """The folder of a bundle of one linear layer, of which every step is cheap; not to be
    changed."""
    import power_cut

    with power_cut.small_versions():
        yield made_once("linear", power_cut.make) / power_cut.NAME


@pytest.fixture(scope="session")
def later_grasps() -> list[np.ndarray]:
    """24 grasps of the same small sensor, healthy, on a later day."""
    grasps = simulate(12, SIMULATED, n_frames=60, seed=99, classes=SMALL_CLASSES)
    return [frames for frames, label in zip(grasps.frames, grasps.labels, strict=True) if label > 0]


def worn(
    recordings: Sequence[np.ndarray], layout: SensorLayout, what: str, force: float = 2.0
) -> list[np.ndarray]:
    """Return recordings with a "strap" over pad 0, or with "gloves": loads are weaker and spread to
    neighbours."""
    if what == "strap":
        y, x = np.indices(layout.shape[1:]) - (np.array(layout.shape[1:]) // 2)[:, None, None]
        strap = np.zeros(layout.shape)
        strap[0] = force * np.exp(-(x**2 + y**2) / 4)
        return [np.minimum(r + strap.ravel(), layout.full_scale) for r in recordings]
    from scipy.ndimage import gaussian_filter

    grids = [r.reshape(-1, *layout.shape) for r in recordings]
    return [0.6 * gaussian_filter(grid, (0, 0, 1, 1)).reshape(len(grid), -1) for grid in grids]


@pytest.fixture(scope="session")
def broken_row() -> Fault:
    return line_fault(SIMULATED, Line(1, "row", 2), "short")
