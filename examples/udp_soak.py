"""A long run over UDP on this machine: is every good packet kept, and does memory stay as it is?

    python examples/udp_soak.py [--packets 100000] [--rate 1000] [--garbage 0.1]

The sender (esp32_sender.py) is a process of its own. Without arguments it runs for two seconds. On
a machine so busy that this process gets no turn, the system's buffer fills, then the queue: such
packets are counted and named, and only one that went without a word is a failure.
"""

import argparse
import asyncio
import resource
import subprocess
import sys
import time
from pathlib import Path

from adaptfault.acquisition import Receiver
from diagnostics import SensorLayout


def resident() -> float:
    """Return the memory of this process in MB."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
    except OSError:  # not Linux: the largest so far
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


async def soak(args: argparse.Namespace) -> int:
    good = round(args.packets * (1 - args.garbage))
    memory = []
    taken = 0
    async with Receiver(SensorLayout.paper()) as receiver:
        options = {
            "port": receiver.port,
            "frames": good,
            "rate": args.rate,
            "garbage": args.garbage,
            "reorder": args.reorder,
        }
        texts = [f"--{name}={value}" for name, value in options.items()]
        sender = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("esp32_sender.py")), *texts],
            stdout=subprocess.PIPE,
            text=True,
        )
        began = time.perf_counter()
        spent = time.process_time()

        async def end() -> None:
            await asyncio.to_thread(sender.wait)
            await asyncio.sleep(1.0)
            receiver.close()

        ending = asyncio.create_task(end())
        async for _ in receiver:
            taken += 1
            if taken % max(1, good // 20) == 0:
                memory.append(resident())
        await ending
        seconds = time.perf_counter() - began
        busy = time.process_time() - spent
    sent = sender.stdout.read().strip()
    sender.stdout.close()
    counters = receiver.counters
    print("sent:    ", sent)
    print("received:", counters)
    unread = int(sent.split(": ")[1].split()[0]) - counters.received
    if unread:
        print(f"unread:   {unread}: the system's buffer was full")
    print(f"kept {taken} of {good} good packets in {seconds:.1f} s; {busy / seconds:.0%} of a core")
    print(f"memory after each twentieth, MB: {' '.join(f'{one:.1f}' for one in memory)}")
    return 0 if good - unread - counters.dropped <= taken <= good and taken else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packets", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--garbage", type=float, default=0.1)
    parser.add_argument("--reorder", type=float, default=0.0)
    return asyncio.run(soak(parser.parse_args()))


if __name__ == "__main__":
    sys.exit(main())
