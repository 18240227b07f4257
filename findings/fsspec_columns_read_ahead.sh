#!/bin/sh
# Guess: pyarrow, asked for one column of a Parquet file that fsspec opens on a server, asks the
#   server for the bytes of this column, as the format is made for.
# Reality: by default the file that fsspec opens reads ahead, 5 MiB at a time, and pyarrow asks for
#   each small piece by itself. Of a file of 40 columns of 100 kB all 4 MB come for the first one.
#   A folder of a thousand such files costs forty times what was wanted, and nobody is told. Opened
#   with cache_type="none", and read with pre_buffer=True, it is the column and the footer alone.
# Packages: fsspec==2026.9.0, aiohttp==3.14.5, pyarrow==26.0.1, numpy==2.4.6
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet fsspec==2026.9.0 aiohttp==3.14.5 pyarrow==26.0.1 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PY'
import io
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import aiohttp
import fsspec
import numpy as np
import pyarrow
import pyarrow.parquet

print("fsspec", fsspec.__version__, "aiohttp", aiohttp.__version__, "pyarrow", pyarrow.__version__)
ROWS = 25_000
rng = np.random.default_rng(0)
columns = {f"c{i}": rng.random(ROWS, dtype=np.float32) for i in range(40)}
stored = io.BytesIO()
pyarrow.parquet.write_table(pyarrow.table(columns), stored, compression="none", use_dictionary=False)
whole = stored.getvalue()
sent = []


class Server(BaseHTTPRequestHandler):
    """Serves the file, whole or a part of it."""

    def log_message(self, format, *args):
        """Print nothing."""

    def do_HEAD(self):
        self.send_response(200)
        self.send_header("Content-Length", str(len(whole)))
        self.send_header("Accept-Ranges", "bytes")
        self.end_headers()

    def do_GET(self):
        first, last = self.headers.get("Range", "bytes=0-").partition("=")[2].split("-")
        part = whole[int(first) : int(last or len(whole)) + 1]
        until = int(first) + len(part) - 1
        sent.append(len(part))
        self.send_response(206)
        self.send_header("Content-Length", str(len(part)))
        self.send_header("Content-Range", f"bytes {first}-{until}/{len(whole)}")
        self.end_headers()
        self.wfile.write(part)


server = ThreadingHTTPServer(("127.0.0.1", 0), Server)
threading.Thread(target=server.serve_forever, daemon=True).start()
files = fsspec.filesystem("http", skip_instance_cache=True)


def read(pre_buffer, **options):
    """Return how much of the file came for one column."""
    sent.clear()
    with files.open(f"http://127.0.0.1:{server.server_port}/log.parquet", **options) as file:
        table = pyarrow.parquet.ParquetFile(file, pre_buffer=pre_buffer)
        (column,) = table.read(columns=["c3"]).columns
    assert column.to_numpy().tobytes() == columns["c3"].tobytes()
    return round(sum(sent) / len(whole), 3), len(sent)


usual = read(False)
wanted = read(True, cache_type="none")
print("one column of 40: share of the file that came, requests:", usual, "without a cache:", wanted)
if usual[0] < 0.9 or wanted[0] > 0.06:
    sys.exit("changed: expected nearly all, and a fortieth with the footer")
PY
