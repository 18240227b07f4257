"""The stacks of compare_keras.py: the paper's network here and in Keras, each served by a process
of its own."""

from __future__ import annotations

import os
import resource
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from multiprocessing.connection import Connection

import numpy as np

import adaptfault as af
from diagnostics import FaultSet, SensorLayout

OURS = "adaptfault"
STACKS = {  # name -> the package it needs
    OURS: "torch",
    "Keras, TensorFlow": "tensorflow",
    "Keras, torch": "torch",
}
Turn = Callable[[], None]
Ways = dict[str, Callable[[np.ndarray], np.ndarray]]


@dataclass(frozen=True)
class Setup:
    """What every stack gets: the array, the windows, and the initial weights as torch names
    them."""

    layout: SensorLayout
    train: af.Windows
    validation: af.Windows
    test: af.Windows
    seed: int
    epochs: int
    small: bool
    weights: dict[str, np.ndarray] = field(repr=False, default_factory=dict)

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return int(self.train.y.max()) + 1


class Ours:
    """The network of this library."""

    def __init__(self, setup: Setup) -> None:
        import torch

        torch.set_num_threads(1)
        self.setup = setup
        length = setup.train.x.shape[1]
        self.model = af.TactileTransformer(
            setup.layout, setup.n_classes, length=length, seed=setup.seed
        ).eval()
        self.parameters = sum(p.numel() for p in self.model.parameters())

    def logits(self, x: np.ndarray) -> np.ndarray:
        """Return the logits of windows."""
        from adaptfault.models.network import logits_of

        return logits_of(self.model, x).numpy()

    def train(self, turn: Turn) -> None:
        """Train, and call ``turn`` after each epoch."""
        s = self.setup
        af.train(
            self.model,
            s.train,
            s.validation,
            epochs=s.epochs,
            patience=None,
            averaging=0,
            seed=s.seed,
            progress=False,
            on_epoch=lambda history: turn(),
        )

    def ways(self) -> Ways:
        """Return the ways to predict."""
        ways: Ways = {"predict": self.model.predict}
        if not self.setup.small and find_spec("onnxruntime") and find_spec("onnxscript"):
            from adaptfault.adaptation.reduced_model import ReducedModel
            from adaptfault.prediction.export import to_onnx
            from adaptfault.prediction.inference import open_session, run_session

            none = FaultSet((), self.setup.layout.n_cells)
            session = open_session(to_onnx(ReducedModel(self.model, none, None).eval()))
            ways["ONNX Runtime"] = lambda x: run_session(session, x).argmax(1)
        return ways


class Keras:
    """The same in Keras; the environment says on which backend."""

    def __init__(self, setup: Setup) -> None:
        import keras

        if keras.backend.backend() == "tensorflow":
            import tensorflow

            tensorflow.config.threading.set_intra_op_parallelism_threads(1)
            tensorflow.config.threading.set_inter_op_parallelism_threads(1)
        else:
            import torch

            torch.set_num_threads(1)
        keras.utils.set_random_seed(setup.seed)
        self.keras = keras
        self.setup = setup
        self.model = keras_network(keras, setup.layout, setup.n_classes, setup.train.x.shape[1])
        self.parameters = self.model.count_params()
        self.model.set_weights(as_keras(setup.weights, setup.layout, self.model))
        self.model.compile(
            optimizer=keras.optimizers.Adam(1e-4),
            loss=keras.losses.SparseCategoricalCrossentropy(from_logits=True),
            metrics=["accuracy"],
        )

    def logits(self, x: np.ndarray) -> np.ndarray:
        """Return the logits of windows."""
        return self.model.predict(x, verbose=0)

    def train(self, turn: Turn) -> None:
        """Train, and call ``turn`` after each epoch."""
        s = self.setup
        callbacks = self.keras.callbacks
        self.model.fit(
            s.train.x,
            s.train.y,
            batch_size=32,
            epochs=s.epochs,
            verbose=0,
            validation_data=(s.validation.x, s.validation.y),
            validation_batch_size=256,
            callbacks=[
                callbacks.EarlyStopping(
                    "val_accuracy", patience=s.epochs, mode="max", restore_best_weights=True
                ),
                callbacks.LambdaCallback(on_epoch_end=lambda epoch, logs: turn()),
            ],
        )

    def ways(self) -> Ways:
        """Return the ways to predict."""

        def call(x: np.ndarray) -> np.ndarray:
            return self.keras.ops.convert_to_numpy(self.model(x, training=False)).argmax(1)

        return {
            "predict": lambda x: self.model.predict(x, batch_size=256, verbose=0).argmax(1),
            "predict_on_batch": lambda x: self.model.predict_on_batch(x).argmax(1),
            "model(x)": call,
        }


def keras_network(keras, layout: SensorLayout, n_classes: int, length: int):
    """Section III-A in Keras, layer by layer as in ``adaptfault/network.py``; positions without a
    cell read 0."""
    layers = keras.layers
    ops = keras.ops
    x = inputs = keras.Input((length, layout.n_cells))
    x = ops.reshape(x, (-1, *layout.shape))  # TimeDistributed goes frame by frame, and takes longer
    x = ops.transpose(x, (0, 2, 3, 1))  # (N * T, rows, cols, pads)
    x = layers.Conv2D(16, 3, padding="same")(x)
    x = layers.Conv2D(32, 3, padding="same")(x)
    d = layout.rows * layout.cols * 32
    x = ops.reshape(x, (-1, length, d))
    for _ in range(2):
        attended = layers.MultiHeadAttention(4, 64)(x, x)
        x = layers.LayerNormalization()(x + layers.Dropout(0.1)(attended))
        fed = layers.Dense(d)(layers.Dense(128, activation="relu")(x))
        x = layers.LayerNormalization()(x + layers.Dropout(0.1)(fed))
    x = layers.GlobalAveragePooling1D()(x)
    x = layers.Dropout(0.1)(layers.Dense(128, activation="relu")(x))
    return keras.Model(inputs, layers.Dense(n_classes)(x))


def as_keras(weights: dict[str, np.ndarray], layout: SensorLayout, model) -> list[np.ndarray]:
    """Return torch's weights in Keras's order and shapes.

    torch flattens a frame as (filter, row, col), Keras as (row, col, filter): the d features change
    places.
    """
    moved = (
        np.arange(32 * layout.rows * layout.cols)
        .reshape(32, layout.rows, layout.cols)
        .transpose(1, 2, 0)
        .ravel()
    )
    w = weights
    result = []
    for name in ("conv1", "conv2"):
        result += [w[f"{name}.weight"].transpose(2, 3, 1, 0), w[f"{name}.bias"]]
    for block in ("blocks.0", "blocks.1"):
        qkv = w[f"{block}.qkv.weight"][:, moved].T.reshape(-1, 3, 4, 64)
        bias = w[f"{block}.qkv.bias"].reshape(3, 4, 64)
        for i in range(3):
            result += [qkv[:, i], bias[i]]
        result += [
            w[f"{block}.out.weight"][moved].T.reshape(4, 64, -1),
            w[f"{block}.out.bias"][moved],
        ]
        result += [w[f"{block}.norm1.{part}"][moved] for part in ("weight", "bias")]
        result += [w[f"{block}.up.weight"][:, moved].T, w[f"{block}.up.bias"]]
        result += [w[f"{block}.down.weight"][moved].T, w[f"{block}.down.bias"][moved]]
        result += [w[f"{block}.norm2.{part}"][moved] for part in ("weight", "bias")]
    result += [w["dense.weight"][:, moved].T, w["dense.bias"], w["head.weight"].T, w["head.bias"]]
    return result


@dataclass(frozen=True)
class Failure:
    """Why a stack stopped."""

    text: str


def serve(connection: Connection, name: str, setup: Setup) -> None:
    """Run one stack in a process of its own, a step each time it is asked: epochs first, then
    predictions."""
    os.environ |= {
        "KERAS_BACKEND": STACKS[name],
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "TF_ENABLE_ONEDNN_OPTS": "1",
    }
    warnings.simplefilter("ignore")
    try:
        stack = Ours(setup) if name == OURS else Keras(setup)
        connection.send((stack.parameters, stack.logits(setup.test.x[:256])))
        began = [0.0, 0.0]

        def start() -> None:
            connection.recv()
            began[:] = time.perf_counter(), time.process_time()

        def turn() -> None:
            connection.send((time.perf_counter() - began[0], time.process_time() - began[1]))
            start()

        start()
        stack.train(turn)
        ways = stack.ways()
        connection.send(float((ways["predict"](setup.test.x) == setup.test.y).mean()))
        while (job := connection.recv()) is not None:
            connection.send(
                {
                    way: timed(predict, setup.test.x[: job[0]], job[1])
                    for way, predict in ways.items()
                }
            )
        connection.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)  # kB on Linux
    except Exception as error:
        connection.send(Failure(f"{type(error).__name__}: {str(error).strip().splitlines()[0]}"))


def timed(
    predict: Callable[[np.ndarray], np.ndarray], x: np.ndarray, runs: int
) -> tuple[float, float]:
    """Return wall (median) and CPU (mean) milliseconds of a prediction, after one that does not
    count."""
    predict(x)
    walls = []
    cpu = time.process_time()
    for _ in range(runs):
        began = time.perf_counter()
        predict(x)
        walls.append(time.perf_counter() - began)
    return 1e3 * float(np.median(walls)), 1e3 * (time.process_time() - cpu) / runs
