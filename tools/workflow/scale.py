#!/usr/bin/env python3
"""What a corpus of N takes would cost, on paper: hours, storage, and where it would break.

usage: scale.py [--takes 10000] [--seed 1] [--json]

Costs are those of `ada` in the README (20 s at 120 fps, 540×960, no OpenFace table, a fit of two minutes on two cores),
grown by what each stage grows with; lengths are log-normal, 5 to 120 s, median 20 s. Machines are simulated stage by
stage: a stage begins when the one before it is done and a machine has the cores and the memory.
"""

import argparse
import heapq
import json
import random
from dataclasses import dataclass

FPS = 120
ADA_FRAMES = 2400
# Stage: CPU seconds for ada, of which this share grows with the take's length, cores it uses, peak MiB.
STAGES = {
    "record": (5.2, 1.0, 1, 99),
    "track": (29.0, 1.0, 1, 197),
    "poses": (50.0, 0.5, 1, 277),
    "dataset": (7.5, 0.3, 1, 167),
    "fit": (217.0, 0.0, 2, 2085),
    "eval": (20.0, 0.0, 1, 700),
    "transfer": (12.0, 0.0, 1, 700),
}
# MB that stay: for ada, share that grows with length, files for ada.
KEPT = {
    "take: video, track, poses": (29.0, 1.0, 14),
    "dataset of 750 frames at scale 2": (239.0, 0.0, 8270),
    "avatar": (236.0, 0.0, 7),
    "evaluation and film": (14.0, 0.0, 70),
    "tables, state, logs": (1.2, 1.0, 40),
}
CHECKPOINTS_MB = 1410  # the newest two, while a fit runs; removed with its last step
# Measured with `tools/corpus --dry-run` for 250 and 1,000 takes: seconds of Snakemake per take of nine jobs.
PLANNING_SECONDS = 0.0103
# Of Snakemake and Python for a job, beside its work; measured with stages that do nothing.
JOB_SECONDS = 0.1


@dataclass
class Machines:
    name: str
    count: int
    cores: int
    memory_mib: int


PLACES = (
    Machines("this machine: 2 cores, 24 GiB", 1, 2, 19_000),
    Machines("a workstation: 32 cores, 128 GiB", 1, 32, 110_000),
    Machines("eight such machines", 8, 32, 110_000),
    Machines("a cluster: 50 nodes of 64 cores, 256 GiB", 50, 64, 220_000),
)


def lengths(count, seed):
    rng = random.Random(seed)
    return [min(120.0, max(5.0, rng.lognormvariate(3.0, 0.7))) for _ in range(count)]


def chain(seconds):
    """(stage, wall seconds, cores, MiB) of a take of so many seconds."""
    grown = seconds * FPS / ADA_FRAMES
    for name, (cpu, share, cores, mib) in STAGES.items():
        yield name, cpu * (1 - share + share * grown) / cores, cores, mib


def simulate(takes, machines, longest_first):
    """Hours until all is done, and the share of the cores that worked. List scheduling with as many events as stages."""
    chains = [list(chain(s)) for s in takes]
    rest = [[sum(w for _, w, _, _ in c[k:]) for k in range(len(c))] for c in chains]
    order = (lambda t, k: (-rest[t][k], t)) if longest_first else (lambda t, k: (t, k))
    cores = [machines.cores] * machines.count
    memory = [machines.memory_mib] * machines.count
    ready = [(order(t, 0), t, 0) for t in range(len(chains))]
    heapq.heapify(ready)
    running, now, busy = [], 0.0, 0.0
    free = list(range(machines.count))
    while ready or running:
        # Begin what fits; machines that are full are left out until something on them ends.
        waiting = []
        while ready and free:
            key, t, k = heapq.heappop(ready)
            _, wall, need, mib = chains[t][k]
            place = next((m for m in free if cores[m] >= need and memory[m] >= mib), None)
            if place is None:
                waiting.append((key, t, k))
                if len(waiting) > 4:
                    break
                continue
            cores[place] -= need
            memory[place] -= mib
            if not cores[place]:
                free.remove(place)
            busy += wall * need
            heapq.heappush(running, (now + wall + JOB_SECONDS, t, k, place))
        for item in waiting:
            heapq.heappush(ready, item)
        now, t, k, place = heapq.heappop(running)
        _, _, need, mib = chains[t][k]
        if not cores[place]:
            free.append(place)
        cores[place] += need
        memory[place] += mib
        if k + 1 < len(chains[t]):
            heapq.heappush(ready, (order(t, k + 1), t, k + 1))
    return now / 3600, busy / (now * machines.cores * machines.count)


def storage(takes):
    grown = [s * FPS / ADA_FRAMES for s in takes]
    sizes = {n: sum(mb * (1 - share + share * g) for g in grown) / 1e6 for n, (mb, share, _) in KEPT.items()}
    return sizes, len(takes) * sum(files for _, _, files in KEPT.values())


def main():
    parser = argparse.ArgumentParser(description="What a corpus would cost, on paper.")
    parser.add_argument("--takes", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    takes = lengths(args.takes, args.seed)
    cpu = {name: sum(w * c for s in takes for n, w, c, _ in chain(s) if n == name) / 3600 for name in STAGES}
    rows = []
    for machines in PLACES:
        first, used = simulate(takes, machines, True)
        plain, _ = simulate(takes, machines, False)
        by_memory = machines.memory_mib // STAGES["fit"][3]
        rows.append({"machines": machines.name, "hours": first, "used": used, "hours_in_order": plain,
                     "fits_at_once": machines.count * min(machines.cores // STAGES["fit"][2], by_memory)})  # fmt: skip
    sizes, files = storage(takes)
    result = {
        "takes": args.takes,
        "hours_of_video": sum(takes) / 3600,
        "cpu_hours": cpu,
        "machines": rows,
        "terabytes": sizes,
        "files_millions": files / 1e6,
        "planning_minutes": args.takes * PLANNING_SECONDS / 60,
    }
    if args.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{args.takes} takes, {result['hours_of_video']:.0f} hours of video, {sum(cpu.values()):.0f} CPU hours:")
    print("  " + ", ".join(f"{n} {h:.0f}" for n, h in cpu.items()))
    print(f"Snakemake plans them in {result['planning_minutes']:.1f} minutes of CPU time\n")
    print("| machines | hours | cores used | fits at once | hours in the table's order |\n|---|---|---|---|---|")
    for r in rows:
        print(f"| {r['machines']} | {r['hours']:.1f} | {r['used']:.0%} | {r['fits_at_once']} | {r['hours_in_order']:.1f} |")
    print("\n| what stays | TB |\n|---|---|")
    for name, tb in sizes.items():
        print(f"| {name} | {tb:.2f} |")
    at_once = max(r["fits_at_once"] for r in rows)
    print(f"| checkpoints, while {at_once} fits run | {at_once * CHECKPOINTS_MB / 1e6:.2f} |")
    print(f"| all that stays, in {result['files_millions']:.0f} million files | {sum(sizes.values()):.2f} |")


if __name__ == "__main__":
    main()
