"""`captures.csv`: the table of takes that a corpus is made of.

    subject,take,video,openface,colmap,driver,views

`subject`, `take` and `video` are needed; paths are relative to the table. `openface`: an OpenFace table instead of
`tracker run`. `colmap`: a COLMAP model instead of finding cameras. `driver`: whose expressions the avatar wears, as
`SUBJECT/TAKE` of this table, a table of curves (.csv), or the folder of a tracked take. `views`: a VIEWS.json with true
pictures, instead of the dataset's held-out frames.
"""

import csv
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

NEEDED = ("subject", "take", "video")
OPTIONAL = ("openface", "colmap", "driver", "views")


class BadTable(Exception):
    """What is wrong with the table, with line and column, and a hint."""

    def __init__(self, message, hint=""):
        super().__init__(message)
        self.hint = hint


@dataclass
class Capture:
    subject: str
    take: str
    video: Path
    openface: Path | None = None
    colmap: Path | None = None
    driver: str = ""
    views: Path | None = None
    line: int = 0
    number: int = 0  # place among the subject's takes, in the order of the table
    driver_id: str | None = field(default=None, compare=False)  # the driver, where it is another row

    @property
    def id(self):
        """A folder's name: everything but letters, digits, `.`, `_` and `-` as `%XX`, subject and take apart by `+`."""
        return f"{quote(self.subject, safe='')}+{quote(self.take, safe='')}"


def read(path):
    """The rows of the table by id, in their order."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise BadTable(f"{path}: does not exist", "check the path") from None
    except (UnicodeDecodeError, IsADirectoryError):
        raise BadTable(f"{path}: is not a text table", "save it as CSV in UTF-8") from None
    rows = csv.DictReader(text.splitlines(), restkey="surplus")
    names = [n.strip().lower() for n in rows.fieldnames or []]
    if not names:
        raise BadTable(f"{path}: the table is empty", f"its first line is {','.join(NEEDED + OPTIONAL)}")
    rows.fieldnames = names
    for name in NEEDED:
        if name not in names:
            raise BadTable(f"{path}:1: there is no column `{name}`", f"columns: {', '.join(NEEDED + OPTIONAL)}")
    unknown = [n for n in names if n not in NEEDED + OPTIONAL]
    if unknown:
        raise BadTable(f"{path}:1: column `{unknown[0]}` is not known", f"columns: {', '.join(NEEDED + OPTIONAL)}")
    captures, counts = {}, {}
    for row in rows:
        if row.get("surplus"):
            raise BadTable(f"{path}:{rows.line_num}: has more cells than the first line", "quote cells with commas")
        capture = _capture(path, rows.line_num, {k: (v or "").strip() for k, v in row.items() if k})
        if capture.id in captures:
            first = captures[capture.id].line
            message = f"{path}:{capture.line}: {capture.subject}/{capture.take} stands in line {first} already"
            raise BadTable(message, "subject and take together name a row")
        capture.number = counts.get(capture.subject, 0)
        counts[capture.subject] = capture.number + 1
        captures[capture.id] = capture
    if not captures:
        raise BadTable(f"{path}: the table has no rows", "a row is a take")
    _find_drivers(path, captures)
    return captures


def _capture(path, line, row):
    for name in NEEDED:
        if not row.get(name):
            raise BadTable(f"{path}:{line}: column `{name}`: is empty", "subject, take and video are needed")
    base = path.resolve().parent
    place = lambda name: base / row[name] if row.get(name) else None  # noqa: E731
    return Capture(
        subject=row["subject"],
        take=row["take"],
        video=base / row["video"],
        openface=place("openface"),
        colmap=place("colmap"),
        driver=row.get("driver", ""),
        views=place("views"),
        line=line,
    )


def _find_drivers(path, captures):
    names = {f"{c.subject}/{c.take}": c.id for c in captures.values()}
    base = path.resolve().parent
    for capture in captures.values():
        if not capture.driver:
            continue
        capture.driver_id = names.get(capture.driver)
        if capture.driver_id is None:
            place = base / capture.driver
            if not place.exists():
                message = f"{path}:{capture.line}: column `driver`: `{capture.driver}` is neither a take nor a path"
                raise BadTable(message, "write SUBJECT/TAKE of this table, a CSV of curves, or a take's folder")
            capture.driver = str(place)
