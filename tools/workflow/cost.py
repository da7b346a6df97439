"""What a stage of a take costs: seconds of one core, and memory, from what stages of other takes have cost.

Each stage has a law that is linear in what it works on; the numbers come from measured runs (`cost.json`, made by
`python3 tools/workflow/cost.py CORPUS...`). What is not known of a take before it is recorded is guessed from its file.

  record    frames · pixels        poses     frames (a given model) or frames (found)
  track     frames                 dataset   chosen frames · pixels of a frame
  fit       steps, or the budget   eval      pictures, swept AUs · levels        transfer   pictures
"""

import json
import sys
from pathlib import Path

STAGES = ("record", "track", "poses", "dataset", "fit", "eval", "transfer", "collect")
# Bytes of a video per frame and pixel, where only the file is known; frames of 60 a second.
BYTES_PER_PIXEL = 0.02


def option(words, name, otherwise):
    """The number behind an option, such as 400 of `--frames 400`."""
    for word, value in zip(words, words[1:]):
        if word == name:
            return float(value.rstrip("sm")) * (60 if value.endswith("m") else 1)
    return otherwise


def features(capture, settings, frames, pixels):
    """By what each stage's cost grows."""
    chosen = min(frames, option(settings["dataset_options"], "--frames", 750))
    scale = option(settings["dataset_options"], "--scale", 4)
    steps = option(settings["fit_options"], "--steps", 0)
    budget = option(settings["fit_options"], "--budget", 120)
    levels = option(settings["eval_options"], "--control-steps", 11) if "--control" in settings["eval_options"] else 0
    fitted = pixels / scale**2
    return {
        "record": frames * pixels * 1e-6,
        "track": 0.0 if capture.openface else frames,
        "poses": 0.0 if capture.colmap else frames,
        "dataset": chosen * pixels * 1e-6,
        "fit": steps or budget * settings["fit_threads"],
        "eval": (chosen / 20 + 17 * 2 * levels) * fitted * 1e-6,
        "transfer": frames * fitted * 1e-6 if capture.driver else 0.0,
        "collect": 0.0,
    }


class Model:
    """Seconds and memory: `a + b · feature` per stage."""

    def __init__(self, laws):
        self.laws = laws

    @classmethod
    def read(cls, path):
        return cls(json.loads(Path(path).read_text())["laws"])

    def law(self, stage, capture, settings):
        if stage == "track" and capture.openface:
            return self.laws["import"]
        if stage == "poses" and capture.colmap:
            return self.laws["model"]
        if stage == "fit" and not option(settings["fit_options"], "--steps", 0):
            return self.laws["fit by time"]
        return self.laws[stage]

    def expect(self, capture, settings, frames=None, pixels=None):
        if frames is None:
            frames, pixels = guess(capture.video)
        by = features(capture, settings, frames, pixels)
        laws = {stage: self.law(stage, capture, settings) for stage in STAGES}
        return Expected(
            {s: law["seconds"][0] + law["seconds"][1] * by[s] for s, law in laws.items()},
            {s: law["mib"][0] + law["mib"][1] * by[s] for s, law in laws.items()},
            {s: settings.get(f"{s}_threads", 1) for s in STAGES},
        )


class Expected:
    """What a take is expected to cost."""

    def __init__(self, cpu_seconds, mib, threads):
        self.cpu_seconds, self.mib, self.threads = cpu_seconds, mib, threads

    def seconds(self, stage):
        return max(0.1, self.cpu_seconds[stage] / max(1, self.threads[stage]))

    def mem_mb(self, stage):
        return max(100, 1.2 * self.mib[stage])

    def rest(self, stage):
        """Seconds from a stage to the end of the chain, at least 1."""
        return max(1, sum(self.seconds(s) for s in STAGES[STAGES.index(stage):]))


def guess(video):
    """Frames and pixels per frame of a file, by its size: good enough for what begins first."""
    try:
        size = video.stat().st_size if video.is_file() else sum(f.stat().st_size for f in video.iterdir())
    except OSError:
        size = 0
    pixels = 1280 * 720 if size > 20e6 else 270 * 480
    return max(2, size / (pixels * BYTES_PER_PIXEL)), pixels


def fit_line(points, through_origin=False):
    """Least squares of y = a + b·x with a and b not below 0. Where there is one x only, a, or b if `through_origin`."""
    n = len(points)
    if not n:
        return [0.0, 0.0]
    mx, my = sum(p[0] for p in points) / n, sum(p[1] for p in points) / n
    spread = sum((p[0] - mx) ** 2 for p in points)
    slope = sum((p[0] - mx) * (p[1] - my) for p in points) / spread if spread > 1e-12 else 0.0
    if spread <= 1e-12 and through_origin and mx > 0:
        return [0.0, round(my / mx, 6)]
    if slope < 0 or spread <= 1e-12:
        return [round(my, 4), 0.0]
    if my - slope * mx < 0:
        return [0.0, round(my / mx, 6)]
    return [round(my - slope * mx, 4), round(slope, 6)]


def measured(corpus):
    """(stage or way of it, feature, CPU seconds, MiB) of every stage that was made in one go in a corpus."""
    import captures

    corpus = Path(corpus)
    settings = json.loads((corpus / "workflow.json").read_text())
    for id_, capture in captures.read(corpus / "captures.csv").items():
        manifest = read_manifest(corpus / "takes" / id_ / "take.toml")
        if not manifest:
            continue
        by = features(capture, settings, manifest["frame_count"], manifest["width"] * manifest["height"])
        if not capture.openface:
            by["track"] = manifest["frame_count"]
        for stage in STAGES:
            outcome = read_json(corpus / "state" / id_ / f"{stage}.json")
            if not outcome.get("made") or "cpu_seconds" not in outcome.get("cost", {}):
                continue
            way = {"track": "import" if capture.openface else "track", "poses": "model" if capture.colmap else "poses"}
            yield way.get(stage, stage), by[stage], outcome["cost"]["cpu_seconds"], outcome["cost"]["peak_mib"], manifest


def read_manifest(path):
    import tomllib

    try:
        return tomllib.loads(path.read_text())
    except (OSError, ValueError):
        return {}


def read_json(path):
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {}


def main():
    rows = [row for corpus in sys.argv[1:] for row in measured(corpus)]
    if not rows:
        sys.exit("usage: cost.py CORPUS...   (corpora that tools/corpus has made)")
    laws = {}
    for way in sorted({row[0] for row in rows}):
        mine = [row for row in rows if row[0] == way]
        laws[way] = {
            "seconds": fit_line([(r[1], r[2]) for r in mine], through_origin=way == "fit"),
            "mib": fit_line([(r[1], r[3]) for r in mine]),
            "measured": len(mine),
        }
    # What a fit of two minutes and more holds, from the README's table; its time is what was asked for, and a save.
    laws["fit by time"] = {"seconds": [5.0, 1.0], "mib": [2300.0, 0.0], "measured": 0}
    lines = [f"  {json.dumps(name)}: {json.dumps(law)}" for name, law in laws.items()]
    print('{\n "about": "CPU seconds and MiB, a + b * feature; see cost.py",\n "laws": {\n' + ",\n".join(lines) + "\n }\n}")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    main()
