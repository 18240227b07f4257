"""Takes a data set from a store in the manner of S3 and from a Hub in that of Hugging Face, which
run here, and asks ones that do not answer: python tests/check_remote.py

Not a test of pytest's: s3fs, moto and huggingface_hub bring fifty packages. ``make remote-check``
makes an environment for it.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import boto3
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from moto.server import ThreadedMotoServer

FEATURES = {"observation.tactile.left": [2, 6], "observation.state": [64]}
EPISODES = 40
ROWS = 60
DEAD = 7


def written(root: Path) -> None:
    """Write a LeRobot set whose cell 7 holds a value in the later half, and a video."""
    rng = np.random.default_rng(0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, ROWS)), 0)[:, None]
    touch = []
    for number in range(EPISODES):
        frames = course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (ROWS, 12))
        if number >= EPISODES // 2:
            frames[:, DEAD] = 0.31
        touch.append(frames.astype(np.float32))
    state = rng.normal(0, 1, (EPISODES * ROWS, 64)).astype(np.float32)
    table = {
        "observation.tactile.left": pa.array(list(np.concatenate(touch))),
        "observation.state": pa.array(list(state)),
        "episode_index": np.repeat(np.arange(EPISODES), ROWS),
    }
    for folder in ("meta", "data/chunk-000", "videos"):
        (root / folder).mkdir(parents=True)
    pq.write_table(pa.table(table), root / "data/chunk-000/file-000.parquet")
    about = {name: {"dtype": "float32", "shape": sizes} for name, sizes in FEATURES.items()}
    about["episode_index"] = {"dtype": "int64", "shape": [1]}
    info = {"codebase_version": "v3.0", "fps": 20, "features": about}
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "videos/front.mp4").write_bytes(os.urandom(1 << 20))


def check(address: str, out: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command."""
    command = [sys.executable, "-m", "adaptfault", "check", address, "--quick", "--out", str(out)]
    stated = ["--shape", "2x6", "--full-scale", "1"]
    print(*command[2:])
    return subprocess.run(
        [*command, *stated], capture_output=True, text=True, env={**os.environ, **environment}
    )


class Hub(ThreadingHTTPServer):
    """A Hub with one data set, me/touch.

    Args:
        root: the folder of the set.

    Attributes:
        sent: bytes of each file that were asked for.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(("127.0.0.1", 0), _Asked)
        self.root = root
        self.sent: Counter[str] = Counter()
        Thread(target=self.serve_forever, daemon=True).start()


class _Asked(BaseHTTPRequestHandler):
    """One request to the Hub."""

    server: Hub

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        """Answer what the set holds, or with a part of a file."""
        where = self.path.partition("?")[0]
        root = self.server.root
        if "/resolve/" in where:
            name = where.partition("/resolve/")[2].partition("/")[2]
            whole = (root / name).read_bytes()
            first, last = (self.headers.get("Range") or "=0-").partition("=")[2].split("-")
            part = whole[int(first) : int(last or len(whole)) + 1]
            self.server.sent[name] += len(part)
            until = int(first) + len(part) - 1
            self._send(part, 206, {"Content-Range": f"bytes {first}-{until}/{len(whole)}"})
        elif "/tree/" in where:
            held = [_entry(file, root) for file in sorted(root.rglob("*"))]
            self._send(json.dumps(held).encode())
        else:
            self._send(json.dumps({"id": "me/touch", "sha": "0" * 40, "siblings": []}).encode())

    def _send(self, body: bytes, code: int = 200, about: dict[str, str] | None = None) -> None:
        self.send_response(code)
        for name, value in {"Content-Length": str(len(body)), **(about or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


def _entry(file: Path, root: Path) -> dict[str, object]:
    """Return how the Hub lists a file or a folder."""
    path = str(file.relative_to(root))
    about = {"path": path, "oid": hashlib.sha1(path.encode()).hexdigest()}
    if file.is_dir():
        return {**about, "type": "directory", "size": 0}
    return {**about, "type": "file", "size": file.stat().st_size}


def passed(place: Path) -> None:
    """Upload the set, check it there and here, and compare."""
    written(place / "touch")
    server = ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    keys = {
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nobody",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "ADAPTFAULT_CACHE": str(place / "cache"),
    }
    os.environ.update(keys)
    store = boto3.client("s3")
    store.create_bucket(Bucket="sets")
    for file in (place / "touch").rglob("*.*"):
        store.upload_file(str(file), "sets", f"touch/{file.relative_to(place / 'touch')}")
    hub = Hub(place / "touch")
    there = {"HF_ENDPOINT": f"http://127.0.0.1:{hub.server_port}"}
    results = []
    addresses = ("s3://sets/touch", "hf://datasets/me/touch", str(place / "touch"))
    for number, address in enumerate(addresses):
        out = place / f"{number}.json"
        done = check(address, out, **there)
        assert done.returncode == 1, done.stderr
        results.append(json.loads(out.read_text())["findings"])
    assert results[0] == results[1] == results[2]
    table = "data/chunk-000/file-000.parquet"
    size = (place / "touch" / table).stat().st_size
    print(f"of {size:,} bytes of the table {hub.sent[table]:,} were read, of the video none")
    assert hub.sent[table] < size / 3, "the state was read, too"
    assert set(hub.sent) == {table, "meta/info.json"}
    assert results[0][0]["cells"] == [DEAD], results[0]
    copies = [file for file in (place / "cache").rglob("*") if file.is_file()]
    assert not [file for file in copies if file.suffix == ".mp4"]
    server.stop()
    for address, missing in (("s3://sets/touch", keys), ("hf://datasets/me/touch", {})):
        silent = {"AWS_MAX_ATTEMPTS": "1", "HF_ENDPOINT": "http://127.0.0.1:9", **missing}
        done = check(address, place / "none.json", **silent)
        said = done.stderr.strip().splitlines()
        assert done.returncode == 3, done.stderr
        assert address in said[-1], done.stderr
        assert len(said) == 1, done.stderr
        print(said[-1])


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        passed(Path(folder))
    print("a set in a store is checked as the same set on the disk")
