"""Settings of a corpus: defaults, then a TOML file, then `--set KEY=VALUE`. Kept as `workflow.json` in the corpus."""

import tomllib
from pathlib import Path

DEFAULTS = {
    "device": "cpu",  # of fit, eval and transfer
    "devices": 0,  # GPUs of this machine; a fit gets one of its own
    "record_threads": 1,
    "track_threads": 1,
    "poses_threads": 1,
    "dataset_threads": 1,
    "fit_threads": 1,
    "eval_threads": 1,
    "record_options": [],
    "track_options": [],
    "poses_options": [],
    "dataset_options": ["--balance"],
    "fit_options": [],
    "eval_options": [],
    "transfer_options": ["--fps", "12"],
    "keep_checkpoints": False,  # what only `trainer fit --resume` needs; three times the size of the avatar
    "retries": 1,  # of a stage that was killed or broke down; a bad take is not tried again
}


class BadSetting(Exception):
    """What is wrong with a setting."""


def resolve(file=None, changes=()):
    settings = dict(DEFAULTS)
    given = {}
    if file:
        try:
            given = tomllib.loads(Path(file).read_text(encoding="utf-8"))
        except OSError as e:
            raise BadSetting(f"{file}: cannot be read: {e.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
            raise BadSetting(f"{file}: {e}") from None
    for change in changes:
        try:
            given |= tomllib.loads(change)
        except tomllib.TOMLDecodeError as e:
            raise BadSetting(f"--set {change}: {e}; write KEY=VALUE as in TOML") from None
    for key, value in given.items():
        if key not in DEFAULTS:
            raise BadSetting(f"there is no setting `{key}`; settings: {', '.join(DEFAULTS)}")
        if type(value) is not type(DEFAULTS[key]):
            raise BadSetting(f"setting `{key}`: expected {type(DEFAULTS[key]).__name__}, found {value!r}")
        settings[key] = [str(v) for v in value] if isinstance(value, list) else value
    return settings
