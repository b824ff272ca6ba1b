"""Change a folder to what a power failure could have left: what was not synced is lost, at random.

The model is a file system with a journal. Names (creations, renames, removals) reach the disk in order, at the latest
when their folder is synced: the last ones may be lost. The content of a file is on the disk up to its size at its last
fsync: the rest may be missing, or zeros.
"""

import os
import random
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

Operation = Mapping[str, Any]
NAMES = {"create", "rename", "remove", "mkdir", "rmdir"}


def durable_sizes(folder: Path) -> dict[int, int]:
    """Return the sizes of a folder's files by inode: everything that is on the disk before a process starts."""
    return {path.stat().st_ino: path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def lose(folder: Path, operations: Iterable[Operation], before: Mapping[int, int], chance: random.Random) -> int:
    """Undo names and cut contents that were not synced; return the number of losses.

    operations: those of the process that was running; before: `durable_sizes` when it started.
    """
    open_names, durable = list[Operation](), dict(before)
    for operation in operations:
        if operation["kind"] in NAMES:
            open_names.append(operation)
        elif operation["kind"] == "sync":
            durable[operation["inode"]] = operation["size"]
            synced = operation["path"]
            open_names = [name for name in open_names if os.path.dirname(name["path"]) != synced]
    lost = sum(_undo(name) for name in reversed(open_names[chance.randint(0, len(open_names)) :]))
    return lost + sum(_cut(path, durable, chance) for path in sorted(folder.rglob("*")) if path.is_file())


def _undo(name: Operation) -> bool:
    """Undo a change of a name, if the process did it before it was killed."""
    path, source, kept = Path(name["path"]), Path(name["source"]), name.get("kept")
    if name["kind"] == "create":
        done = path.is_file()
        path.unlink(missing_ok=True)
    elif name["kind"] == "mkdir":
        done = path.is_dir()
        shutil.rmtree(path, ignore_errors=True)
    elif name["kind"] == "rmdir":
        done = not path.exists()
        path.mkdir(exist_ok=True)
    elif name["kind"] == "remove":
        done = bool(kept) and not path.exists() and path.parent.is_dir()
        if done:
            os.link(str(kept), path)
    else:
        done = path.exists() and not source.exists()
        if done:
            os.replace(path, source)
            if kept:
                os.link(str(kept), path)
    return done


def _cut(path: Path, durable: Mapping[int, int], chance: random.Random) -> bool:
    """Cut or clear the content of a file after its durable part."""
    status = path.stat()
    end = durable.get(status.st_ino, 0)
    if status.st_size <= end:
        return False
    kept = chance.randint(end, status.st_size)
    copy = path.with_name(f"{path.name}.cut")  # kept links share the content
    content = path.read_bytes()[:kept]
    copy.write_bytes(content if chance.random() < 0.5 else content.ljust(status.st_size, b"\0"))
    os.replace(copy, path)
    return True
