#!/usr/bin/env python3
"""CPU time and wall time per picture of `trainer view`, turning, editing and both, without a browser. Standard library only.

usage: tools/bench/view/view.py RUN [--trainer target/release/trainer] [--pictures 30]
"""

import argparse
import json
import math
import os
import re
import statistics
import subprocess
import time
import urllib.request


def cpu_secs(pid):
    fields = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--trainer", default="target/release/trainer")
    parser.add_argument("--pictures", type=int, default=30)
    args = parser.parse_args()
    child = subprocess.Popen([args.trainer, "view", args.run], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        url = re.search(r"http\S+", child.stderr.readline()).group()
        info = json.load(urllib.request.urlopen(url + "info.json"))

        def picture(**request):
            body = json.dumps(request).encode()
            answer = urllib.request.urlopen(urllib.request.Request(url + "frame", body, method="POST"))
            answer.read()
            return int(answer.headers["X-Width"]), int(answer.headers["X-Height"])

        turn = lambda t: {"yaw_deg": 12 * math.sin(t), "pitch_deg": 5 * math.cos(t)}
        smile = lambda t: {"AU12": round(2 + 2 * math.sin(t), 1)}
        work = {
            "turning": lambda t, scale: picture(orbit=turn(t), scale=scale),
            "editing": lambda t, scale: picture(aus=smile(t), scale=scale),
            "turning, edited": lambda t, scale: picture(orbit=turn(t), aus=smile(t), scale=scale),
        }
        print(f"{'':16} {'size':>9} {'CPU ms':>7} {'wall ms, median':>16}    of {args.pictures} pictures, load {os.getloadavg()[0]:.1f}")
        for name, take in work.items():
            for scale in (1, 0.5, 0.31):
                take(0, scale)
                walls, began = [], cpu_secs(child.pid)
                for i in range(1, args.pictures + 1):
                    at = time.perf_counter()
                    size = take(i * 0.35, scale)
                    walls.append(1e3 * (time.perf_counter() - at))
                cpu = 1e3 * (cpu_secs(child.pid) - began) / args.pictures
                print(f"{name:16} {size[0]:4}×{size[1]:<4} {cpu:7.1f} {statistics.median(walls):16.1f}")
        assert info["width"] > 0
    finally:
        child.terminate()
        child.wait()


if __name__ == "__main__":
    main()
