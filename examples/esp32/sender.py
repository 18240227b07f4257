"""The sender of sender.c in MicroPython: frames as UDP packets, and scans of the read-out.

``board`` is yours, an object with ``drive(row, level)`` (None: held at ground, 0: let go, up to 1:
share of the drive), ``read(column, is_scan)`` (counts; ``is_scan``: the gain of a scan), ``now()``
(milliseconds) and ``send(packet)``:

    sender = Sender(board, "hand", 11, 10)
    sender.scan()  # once, with nobody touching
    while True:
        sender.frame()
        time.sleep_ms(100)
"""

TOP = 4095  # highest count of the converter
REPEATS = 16  # of each level of a scan
LOW = 1 / 64  # a cell at full scale reads half of the range there
LEVELS = (0, LOW, 1)


class Sender:
    """Sends the crossings of an array of rows and columns."""

    def __init__(self, board, device, rows, columns):
        self.board = board
        self.device = device
        self.rows = rows
        self.columns = columns

    def frame(self):
        """Send an ordinary frame, in counts."""
        counts = self._counts(1, False)
        self._send("", [str(count) for count in counts])

    def scan(self):
        """Send a scan: shares of the converter's range."""
        for level in LEVELS:
            for _ in range(REPEATS):
                counts = self._counts(level, True)
                self._send(f"scan={level:.9g},", [share(count) for count in counts])

    def _counts(self, level, is_scan):
        counts = []
        for row in range(self.rows):
            self.board.drive(row, level)
            for column in range(self.columns):
                counts.append(self.board.read(column, is_scan))
            self.board.drive(row, None)
        return counts

    def _send(self, scan, values):
        head = f"{self.device},{self.board.now()},{scan}"
        self.board.send((head + ",".join(values)).encode())


def share(count):
    """Return a count as a share of the range, in six characters at most."""
    digits = (count * 10000 + TOP // 2) // TOP
    if digits == 0:
        return "0"
    return "1" if digits >= 10000 else f".{digits:04d}"
