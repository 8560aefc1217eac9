"""How OpenMP's threads should wait for each other: an image and its gradient, on an idle machine and on a busy one.

    python benchmarks/threads.py [--repeats 5]

Each way of waiting runs in a process of its own. torch's own way is to spin on. The command line's way is to spin for
microseconds (GOMP_SPINCOUNT=1000) and then sleep. The third way is to sleep at once (OMP_WAIT_POLICY=PASSIVE), the
fourth a single thread. Then all run again beside a program that keeps one core busy. Seconds are the least of the
repeats, by wall clock.
"""

import argparse
import json
import os
import subprocess
import sys
import time

WAYS = {
    "torch's own": {},
    "the command line's": {"GOMP_SPINCOUNT": "1000"},
    "asleep at once": {"OMP_WAIT_POLICY": "PASSIVE"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
PROPAGATIONS: tuple[str, ...] = ("projection", "rays", "wave")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How OpenMP's threads should wait for each other.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.alone:
        print(json.dumps([seconds(propagation, arguments.repeats) for propagation in PROPAGATIONS]))
        return
    print(f"| machine | threads | {', s | '.join(PROPAGATIONS)}, s |\n|---|---|{'---|' * len(PROPAGATIONS)}")
    free = {k: v for k, v in os.environ.items() if k not in ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    for busy in (False, True):
        other = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if busy else None
        try:
            for way, variables in WAYS.items():
                command = [sys.executable, __file__, *sys.argv[1:], "--alone"]
                done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env={**free, **variables})
                cells = " | ".join(f"{s:.3f}" for s in json.loads(done.stdout))
                print(f"| {'with one core taken' if busy else 'idle'} | {way} | {cells} |", flush=True)
        finally:
            if other is not None:
                other.kill()


def seconds(propagation: str, repeats: int) -> float:
    """Seconds of an image of 20×64×64 voxels by 16 sources, at 7 planes behind 2 prisms, and its gradient."""
    import torch

    from data_synthetic import GaussianBall
    from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

    grid = Grid((20, 64, 64), (0.4, 0.18, 0.18))
    delta = torch.nn.Parameter(GaussianBall(1.0, 0.02, 1.36).delta(grid, dtype=torch.float32))
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.6))
    acquisition = Acquisition([Prism((0.0, 0.2), 1.0), Prism((0.2, 0.0), 1.0)], [float(z) for z in range(-3, 4)])
    least = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        volume = Volume(grid, delta, 1.36)
        image(volume, microscope, acquisition, Fidelity(propagation, sources=16)).square().sum().backward()
        least = min(least, time.perf_counter() - start)
    return least


if __name__ == "__main__":
    main()
