"""Counts the instructions of one frame of the monitor in C: on a Cortex-M4 that QEMU emulates, or
with valgrind on this machine.

    python examples/monitor_cost.py [robot.bundle] [--cells 11x10 --pads 2]

Without a bundle it takes limits of simulated grasps. QEMU: apt-get install
qemu-system-arm gcc-arm-none-eabi libnewlib-arm-none-eabi. Instructions are counted, not cycles: a
Cortex-M4 takes one or two cycles for each, and waits for its flash.
"""

import argparse
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from adaptfault.firmware import Limits, monitor_source
from adaptfault.firmware.counting import PREDICTORS, TOP
from diagnostics import SensorLayout

FRAMES = (4, 12)  # of two runs: their difference is free of the start
MAIN = """
#include "monitor.c"
int main(void)
{
    static monitor skin;
    static int16_t frame[MONITOR_CELLS];
    uint32_t random = 1;
    int told = 0;
    monitor_begin(&skin);
    for (int t = 0; t < FRAMES; t++) {
        for (int i = 0; i < MONITOR_CELLS; i++) {
            random = random * 1664525u + 1013904223u;
            frame[i] = (int16_t)((random >> 24) * LOADED + t % 2);
        }
        CALL;
    }
    return told != 0;
}
"""
BARE = """
int main(void);
void reset(void);
__attribute__((section(".vectors"), used)) static void *const vectors[] = {
    (void *)0x20040000, (void *)reset};
void *memset(void *to, int value, unsigned long bytes)
{
    for (volatile char *byte = to; bytes--;) *byte++ = (char)value;
    return to;
}
void *memcpy(void *to, const void *from, unsigned long bytes)
{
    for (unsigned long i = 0; i < bytes; i++) ((volatile char *)to)[i] = ((const char *)from)[i];
    return to;
}
void reset(void)
{
    main();
    register unsigned what __asm__("r0") = 0x18;
    register unsigned why __asm__("r1") = 0x20026;
    __asm__ volatile("bkpt 0xab" : : "r"(what), "r"(why) : "memory");
    for (;;) {}
}
"""
LINKED = """
SECTIONS {
    . = 0;
    .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) }
    . = 0x20000000;
    .data : { *(.data*) }
    .bss : { *(.bss*) *(COMMON) }
    /DISCARD/ : { *(.ARM.*) *(.comment) }
}
"""
CALLS = {
    "a frame in which no cell leaves its run": (0, "monitor_update(&skin, frame)"),
    "a frame in which every cell moves": (1, "monitor_update(&skin, frame)"),
    "the same, and the state of each cell": (
        1,
        "monitor_update(&skin, frame); "
        "for (int i = 0; i < MONITOR_CELLS; i++) told += monitor_state(&skin, i)",
    ),
}


def limits_of(layout: SensorLayout) -> Limits:
    """Return limits with the four cells behind each one as predictors: the cost does not depend on
    the numbers."""
    cells = np.arange(layout.n_cells)
    behind = cells[:, None] + np.arange(1, PREDICTORS + 1)
    return Limits(
        per_unit=1.0,
        dither=5,
        near=10,
        patience=32,
        silent_after=32,
        rest=np.zeros(layout.n_cells, np.int16),
        lowest=np.full(layout.n_cells, -TOP, np.int16),
        highest=np.full(layout.n_cells, TOP, np.int16),
        stuck_after=np.full(layout.n_cells, 200, np.uint16),
        predictors=(behind % layout.n_cells).astype(np.uint16),
    )


def built(folder: Path, compiler: list[str], frames: int, loaded: int, call: str) -> Path:
    """Compile, and return the program."""
    (folder / "main.c").write_text(MAIN)
    (folder / "bare.c").write_text(BARE)
    (folder / "bare.ld").write_text(LINKED)
    defined = [f"-DFRAMES={frames}", f"-DLOADED={loaded}", f"-DCALL={call}"]
    made = [*compiler, "-std=gnu99", "-O2", *defined, "main.c", "-o", "program"]
    subprocess.run(made, cwd=folder, check=True)
    return folder / "program"


def on_cortex_m4(program: Path) -> int:
    """Return the instructions of a run: QEMU logs each where it takes them one by one."""
    log = program.with_suffix(".log")
    machine = ["-M", "mps2-an386", "-nographic", "-semihosting", "-monitor", "none"]
    options = [*machine, "-singlestep", "-d", "exec,nochain", "-D", log, "-kernel", program]
    ran = subprocess.run(["qemu-system-arm", *options], stdin=subprocess.DEVNULL)
    if ran.returncode:
        raise SystemExit(f"qemu-system-arm ended with {ran.returncode}: {log.read_text()[-300:]}")
    with log.open("rb") as lines:
        return sum(line.startswith(b"Trace") for line in lines)


def with_valgrind(program: Path) -> int:
    """Return the instructions of a run on this machine."""
    options = ["--tool=callgrind", f"--callgrind-out-file={program}.callgrind"]
    ran = subprocess.run(["valgrind", *options, program], capture_output=True, text=True)
    return int(re.search(r"Collected : (\d+)", ran.stderr)[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", nargs="?", help="default: an array of --pads and --cells")
    parser.add_argument("--pads", type=int, default=2)
    parser.add_argument("--cells", default="11x10", help="rows x columns")
    args = parser.parse_args()
    rows, cols = map(int, args.cells.split("x"))
    layout = SensorLayout(args.pads, rows, cols)
    limits = limits_of(layout)
    if args.bundle:
        from adaptfault import Bundle
        from adaptfault.firmware import learn_limits

        bundle = Bundle.open(args.bundle)
        layout = bundle.layout
        healthy = bundle.parts.recordings(layout.full_scale)
        limits = learn_limits(bundle.diagnoser(), healthy)
    arm = shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")
    if not arm and not shutil.which("valgrind"):
        print("no instruction counter: install qemu-system-arm and gcc-arm-none-eabi, or valgrind")
        return
    where = "Cortex-M4 (QEMU)" if arm else "this machine (valgrind)"
    compiler = ["gcc"]
    if arm:
        compiler = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-nostdlib"]
        compiler += ["-fno-tree-loop-distribute-patterns", "-T", "bare.ld", "bare.c"]
    count = on_cortex_m4 if arm else with_valgrind
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "monitor.c").write_text(monitor_source(limits, layout))
        for name, (loaded, call) in CALLS.items():
            runs = [
                count(built(folder, compiler, n, loaded, what))
                for what in ("", call)
                for n in FRAMES
            ]
            without, with_monitor = np.diff(runs)[[0, 2]] / (FRAMES[1] - FRAMES[0])
            each = (with_monitor - without) / layout.n_cells
            print(
                f"{where}: {name}: {each:.1f} instructions a cell, "
                f"{with_monitor - without:.0f} a frame of {layout.n_cells} cells"
            )


if __name__ == "__main__":
    main()
