#!/usr/bin/env python3
"""Runs one stage of one take: what every rule of the Snakefile calls, in the corpus' folder.

usage: stage.py STAGE ID [--attempt N]

The outcome goes to state/ID/STAGE.json. Exit status, and what becomes of it:

  0  done, or the take is bad: that is listed, later stages of the take are passed by, all others go on
  2  the installation lacks something: every take would fail, so STOP.json is written and nothing else is begun
  3  the stage broke down or was killed: Snakemake tries it again, as the stages allow (see docs/corpora.md)
"""

import argparse
import contextlib
import fcntl
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.dont_write_bytecode = True

import captures  # noqa: E402

STAGES = ("record", "track", "poses", "dataset", "fit", "eval", "transfer", "collect")
# Whose failure passes a stage by.
NEEDS = {
    "record": [],
    "track": ["record"],
    "poses": ["track"],
    "dataset": ["poses"],
    "fit": ["dataset"],
    "eval": ["fit"],
    "transfer": ["fit"],
    "collect": ["dataset"],
}
STOP = Path("STOP.json")
# Less free room than this, and a failure is the machine's and not the take's.
FREE_BYTES = 64 << 20


def main():
    parser = argparse.ArgumentParser(description="Runs one stage of one take.")
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("id")
    parser.add_argument("--attempt", type=int, default=1)
    args = parser.parse_args()
    if STOP.exists():
        return 2
    settings = json.loads(Path("workflow.json").read_text())
    capture = captures.read("captures.csv")[args.id]
    work = Work(args.stage, capture, settings, args.attempt)
    return work.run()


class Work:
    def __init__(self, stage, capture, settings, attempt):
        self.stage, self.capture, self.settings, self.attempt = stage, capture, settings, attempt
        self.state = Path("state") / capture.id
        self.log = Path("logs") / capture.id / f"{stage}.log"
        self.child, self.stopping = None, False

    def run(self):
        self.state.mkdir(parents=True, exist_ok=True)
        self.log.parent.mkdir(parents=True, exist_ok=True)
        failed = self.failed_before()
        if failed:
            return self.end(ok=False, skipped=True, because=failed)
        command = self.command()
        if command is None:
            return self.end(ok=True, skipped=True, because="not asked for")
        self.note("begin", attempt=self.attempt)
        with self.device() as environment:
            status, document, said, seconds, usage = self.execute(command, environment)
        if self.stopping and status != 0:
            self.note("stopped", status=status)
            return 3
        cost = {"seconds": seconds, **usage}
        if status == 0:
            self.after()
            return self.end(ok=True, made=not document.get("up_to_date", False), cost=cost, result=document)
        error = (document.get("error") or {}) if isinstance(document, dict) else {}
        message = error.get("message") or last_line(said) or f"ended with status {status}"
        hint = error.get("hint") or ""
        free = shutil.disk_usage(".").free
        bug = "this is a bug in" in message
        lacks = error.get("of_installation", False) or (status == 2 and not bug)
        if lacks or "no space left" in message or free < FREE_BYTES:
            if free < FREE_BYTES:
                message, hint = f"the disk is full: {message}", "free some disk space and run the same command again"
            write_json(STOP, {"stage": self.stage, "take": name(self.capture), "error": message, "hint": hint})
            self.note("stop", error=message)
            print(f"STOP {name(self.capture)} {self.stage}: {message}", file=sys.stderr)
            return 2
        if status == 1 or bug:
            print(f"{name(self.capture)} {self.stage}: {message}", file=sys.stderr)
            return self.end(ok=False, error=message, hint=hint, status=status, cost=cost)
        self.note("broke", status=status, error=message)
        print(f"{name(self.capture)} {self.stage} broke down ({status}): {message}", file=sys.stderr)
        return 3

    def failed_before(self):
        """The stage whose failure passes this one by."""
        for stage in NEEDS[self.stage]:
            before = read_json(self.state / f"{stage}.json")
            if not before.get("ok"):
                return before.get("because") if before.get("skipped") else stage
        if self.stage == "transfer" and self.capture.driver_id:
            track = read_json(Path("state") / self.capture.driver_id / "track.json")
            if not track.get("ok"):
                return f"driver {self.capture.driver} has no track"
        return None

    def command(self):
        c, s, id_ = self.capture, self.settings, self.capture.id
        take, dataset, run = f"takes/{id_}", f"datasets/{id_}", f"runs/{id_}"
        again = ["--if-changed"]
        threads = ["--threads", str(s["fit_threads" if self.stage == "transfer" else f"{self.stage}_threads"])] \
            if self.stage in ("fit", "eval", "transfer") or (self.stage == "track" and not c.openface) else []
        device = ["--device", s["device"]] if self.stage in ("fit", "eval", "transfer") else []
        more = s.get(f"{self.stage}_options", [])
        if self.stage == "record":
            words = ["capture", "record", "--input", c.video, "--out", take, "--subject", c.subject, "--force"]
        elif self.stage == "track" and c.openface:
            words, more = ["tracker", "import", take, "--openface", c.openface], []
        elif self.stage == "track":
            words = ["tracker", "run", take]
        elif self.stage == "poses":
            model = ["--colmap-model", c.colmap] if c.colmap else []
            words, more = ["tracker", "poses", take, *model], [] if model else more
        elif self.stage == "dataset":
            words = ["dataset", "build", take, "--out", dataset]
        elif self.stage == "fit":
            words = ["trainer", "fit", dataset, "--out", run, "--force"]
        elif self.stage == "eval":
            words = ["trainer", "eval", run, *(["--views", c.views] if c.views else [])]
        elif self.stage == "transfer":
            if not c.driver:
                return None
            if c.driver_id:
                source = ["--from", f"takes/{c.driver_id}"]
            else:
                source = ["--curves" if c.driver.endswith(".csv") else "--from", c.driver]
            words = ["trainer", "transfer", run, *source, "--video", f"transfers/{id_}.mp4"]
        else:
            # Of a take whose avatar failed, the tables of the dataset are filed all the same.
            fitted = read_json(self.state / "fit.json").get("ok")
            words = ["dataset", "collect", dataset, "--out", ".", "--subject", c.subject, "--take", c.take]
            words += ["--number", c.number, *(["--run", run] if fitted else [])]
            again, more = [], []
        program, *rest = map(str, [*words, *threads, *device, *more, *again, "--json", "--no-progress"])
        return [str(Path(os.environ["RISORIUS_BIN"]) / program), *rest]

    @contextlib.contextmanager
    def device(self):
        """One device for one stage at a time: CUDA_VISIBLE_DEVICES of a device that no other stage has."""
        count = self.settings["devices"]
        if self.settings["device"] == "cpu" or not count or self.stage not in ("fit", "eval", "transfer"):
            yield {}
            return
        Path(".devices").mkdir(exist_ok=True)
        while True:
            for device in range(count):
                with open(f".devices/{device}", "w") as lock:
                    try:
                        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except OSError:
                        continue
                    yield {"CUDA_VISIBLE_DEVICES": str(device)}
                    return
            time.sleep(0.5)

    def execute(self, command, environment):
        threads = str(self.settings.get(f"{self.stage}_threads", self.settings["fit_threads"]))
        environment = {**os.environ, "RAYON_NUM_THREADS": threads, "POLARS_MAX_THREADS": threads, **environment}
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        with open(self.log, "a") as log:
            log.write(f"\n$ {time.strftime('%F %T')} attempt {self.attempt}: {' '.join(command)}\n")
            log.flush()
            start = log.tell()
            output = self.log.with_suffix(".out")
            with open(output, "w+") as out:
                self.child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=log, env=environment)
                for number in (signal.SIGTERM, signal.SIGINT):
                    signal.signal(number, self.stopped)
                status = self.child.wait()
        seconds, after = time.monotonic() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        text = output.read_text(errors="replace")
        output.unlink()
        with open(self.log, errors="replace") as log:
            log.seek(start)
            said = log.read()
        try:
            document = json.loads(text)
        except ValueError:
            document = {}
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        usage = {"cpu_seconds": round(cpu, 3), "peak_mib": round(after.ru_maxrss / 1024, 1)}
        if "goes on from its newest checkpoint" in said:
            self.note("goes on")
        return status, document if isinstance(document, dict) else {}, said, round(seconds, 3), usage

    def stopped(self, number, _frame):
        """Lets the stage leave whole files; a take whose stage was stopped is not a bad one."""
        # Ctrl-C reaches the stage by itself, and a second one would end it at once.
        if self.child and not self.stopping and number == signal.SIGTERM:
            self.child.send_signal(number)
        self.stopping = True

    def after(self):
        if self.stage == "fit" and not self.settings["keep_checkpoints"]:
            shutil.rmtree(Path("runs") / self.capture.id / "checkpoints", ignore_errors=True)

    def end(self, **outcome):
        outcome = {"stage": self.stage, "take": name(self.capture), **outcome}
        said = {k: outcome[k] for k in ("ok", "made", "skipped", "because", "error") if k in outcome}
        self.note("end", **said)
        write_json(self.state / f"{self.stage}.json", outcome)
        return 0

    def note(self, event, **more):
        line = {"time": time.strftime("%F %T"), "stage": self.stage, "event": event, **more}
        with open(self.state / "journal.jsonl", "a") as journal:
            journal.write(json.dumps(line) + "\n")


def name(capture):
    return f"{capture.subject}/{capture.take}"


def last_line(text):
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("hint:")]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return (errors or lines or [""])[-1]


def read_json(path):
    try:
        return json.loads(Path(path).read_text())
    except (OSError, ValueError):
        return {}


def write_json(path, document):
    staging = Path(f"{path}.{os.getpid()}.part")
    staging.write_text(json.dumps(document, indent=1) + "\n")
    staging.replace(path)


if __name__ == "__main__":
    sys.exit(main())
