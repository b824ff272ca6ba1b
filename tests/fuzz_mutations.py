"""Change valid input files in the ways in which hostile or damaged files differ from them."""

import gzip
import io
import json
import os
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sigmasplat.files.reading import DAMAGED

Files = dict[str, bytes]
PIPE, FOLDER, LOOP, BROKEN, ZERO = (f"\0{kind}".encode() for kind in ("pipe", "folder", "loop", "broken", "zero"))
"""Contents that stand for other entries than files: written by `write_files`."""

NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-1", "-0.0", "1" * 400, "9" * 5000, "99999999999999999999",
    "2147483648", "4294967295", "1e400", "0x10", "1_000", "²", "٣", "", "0.5", "1e9", "65536", "255", "-32769", "1e17",
)  # fmt: skip
TEXTS = ("", "\0", "a" * 300, "../../../etc/passwd", "/dev/zero", "\ud7ff\U0001f600", "%s%n", "1²2", "null", "‮", "a\nb")
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**400, 0.5, 1e308, -1e308, 1e-320, float("nan"), float("inf"),
    "", "x", "\0", "a" * 300, [], {}, [[]], [None], {"a": 1}, [1e308] * 20, ["x"] * 20,
)  # fmt: skip
WORDS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x100000000, 2**63 - 1, 2**64 - 1)
NUMBER = re.compile(rb"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?")
TEXT_ENDINGS = (".txt", ".csv", ".log", ".json", ".jsonl", ".freiburg", ".yaml", ".gltf", "metadata")


def mutated(files: Files, rng: random.Random) -> Files:
    """Return the files with one to three changes."""
    changed = dict(files)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name = rng.choice(sorted(changed))
        if rng.random() < 0.15:
            _entry(changed, name, rng)
        elif len(changed[name]) and not changed[name].startswith(b"\0"):
            changed[name] = _content(name, changed[name], rng)
    return changed


def write_files(folder: Path, files: Files) -> None:
    """Write the files, pipes, links and folders. Names that the system refuses are left out."""
    for name, content in files.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if content == PIPE:
                os.mkfifo(path)
            elif content == FOLDER:
                path.mkdir()
            elif content in (LOOP, BROKEN, ZERO):
                path.symlink_to({LOOP: path.name, BROKEN: "nothing-here", ZERO: "/dev/zero"}[content])
            else:
                path.write_bytes(content)
        except (OSError, ValueError):
            continue


def _entry(files: Files, name: str, rng: random.Random) -> None:
    """Remove, exchange, rename or copy a file, or put something else in its place."""
    kind, other = rng.randrange(7), rng.choice(sorted(files))
    if kind == 0:
        del files[name]
        files.setdefault("left.txt", b"")
    elif kind == 1:
        files[name], files[other] = files[other], files[name]
    elif kind == 2:
        files[name] = rng.choice((PIPE, FOLDER, LOOP, BROKEN, ZERO, b""))
    elif kind == 3:
        files[name] = files[other]
    else:
        path = Path(name)
        stem = rng.choice(
            ("1²2", "a" * 240, "99999999999999999999", "1" * 200, "-1", "nan", "1e308", path.stem + "x", "é")
        )
        files[str(path.with_name(stem + path.suffix))] = files.pop(name) if kind < 6 else files[name]


def _content(name: str, data: bytes, rng: random.Random) -> bytes:
    """Change a file by its format, as text, or byte by byte."""
    structured = _by_format(name, data)
    if structured and rng.random() < 0.6:
        try:
            return structured(data, rng)
        except DAMAGED:
            return _bytes(data, rng)
    if name.endswith(TEXT_ENDINGS) and rng.random() < 0.7:
        return _text(data, rng)
    return _bytes(data, rng)


def _by_format(name: str, data: bytes) -> Callable[[bytes, random.Random], bytes] | None:
    if name.endswith((".json", ".gltf", "metadata")):
        return _json
    if name.endswith(".jsonl"):
        return _json_line
    if data.startswith(b"\x89PNG"):
        return _png
    if data.startswith(b"PK\x03\x04"):
        return _zip
    if data.startswith(b"\x1f\x8b"):
        return _gzip
    if data.startswith(b"\x93NUMPY"):
        return _npy
    if name.endswith(".safetensors"):
        return _safetensors
    if name.endswith(".ply"):
        return _ply
    return _csv if name.endswith(".csv") else None


def _bytes(data: bytes, rng: random.Random) -> bytes:
    kind, at = rng.randrange(7), rng.randrange(len(data))
    # Headers decide most, and they are at the beginning or at the end.
    at = rng.choice((at, at % 64, -1 - at % 64 + len(data))) % len(data)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 2:
        return data[:at] + rng.randbytes(rng.choice((1, 2, 8, 300))) + data[at:]
    if kind == 3:
        return data[:at] + data[at + rng.choice((1, 2, 8, 100)) :]
    if kind == 4:
        size, order = rng.choice((2, 4, 8)), rng.choice(("little", "big"))
        word = (rng.choice(WORDS) % (1 << 8 * size)).to_bytes(size, order)  # type: ignore[arg-type]
        at -= at % rng.choice((1, 2, 4))
        return data[:at] + word + data[at + size :]
    if kind == 5:
        size = rng.choice((4, 16, 64))
        return data[:at] + rng.choice((b"\0", b"\xff", b"\x7f")) * size + data[at + size :]
    return data + rng.choice((data, b"\0" * 1000, rng.randbytes(100)))


def _text(data: bytes, rng: random.Random) -> bytes:
    kind, lines = rng.randrange(10), data.split(b"\n")
    line = rng.randrange(len(lines))
    if kind < 4 and (found := list(NUMBER.finditer(data))):
        match = rng.choice(found)
        return data[: match.start()] + rng.choice(NUMBERS).encode() + data[match.end() :]
    if kind == 4 and (found := list(re.finditer(rb"[^\s,\"]+", data))):
        match = rng.choice(found)
        return data[: match.start()] + rng.choice(TEXTS).encode("utf-8", "surrogatepass") + data[match.end() :]
    if kind == 5:
        return b"\n".join(lines[:line] + lines[line + 1 :])
    if kind == 6:
        return b"\n".join(lines[:line] + [lines[line]] * rng.choice((2, 3000)) + lines[line:])
    if kind == 7:
        return rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\xff", b"\0")) + data
    if kind == 8:
        return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"", b"\n\n")))
    return b"\n".join(
        [*lines[:line], rng.choice((b"x" * 200_000, b"\xff\xfe", b"a b c d e f g h", b"#")), *lines[line:]]
    )


def _csv(data: bytes, rng: random.Random) -> bytes:
    lines = [line.split(b",") for line in data.split(b"\n")]
    line = rng.choice(lines)
    cell = rng.randrange(len(line))
    line[cell] = rng.choice((b'"', b"x" * 140_000, *(number.encode() for number in NUMBERS)))
    return b"\n".join(b",".join(line) for line in lines)


def _json(data: bytes, rng: random.Random) -> bytes:
    tree = json.loads(data)
    kind = rng.randrange(12)
    if kind == 0:
        return b"[" * 200_000 if rng.random() < 0.5 else b'{"a":' * 100_000 + b"1" + b"}" * 100_000
    if kind == 1:
        return json.dumps(rng.choice(([], None, 3, "x", [tree], {}, {"a": tree}))).encode()
    return json.dumps(_changed_tree(tree, rng)).encode()


def _json_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(max(1, len(lines) - 1))
    return b"\n".join([*lines[:at], _json(lines[at], rng), *lines[at + 1 :]])


def _changed_tree(tree: Any, rng: random.Random) -> Any:
    """Change one node of a JSON tree: replace, delete or repeat it."""
    nodes: list[tuple[Any, Any]] = []
    stack = [tree]
    while stack:
        node = stack.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        nodes += [(node, key) for key in keys]
        stack += [node[key] for key in keys]
    if not nodes:
        return rng.choice(VALUES)
    if rng.random() < 0.5:  # long lists of numbers must not hide the few fields
        nodes = [pair for pair in nodes if isinstance(pair[0], dict)] or nodes
    node, key = rng.choice(nodes)
    kind = rng.randrange(6)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, list):
        node[key : key + 1] = [node[key]] * 1000
    elif kind == 2:
        node[key] = str(node[key])
    elif kind == 3:
        node[key] = [node[key]]
    else:
        node[key] = rng.choice(VALUES)
    return tree


def _png(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a PNG, with a correct checksum."""
    width, height, *rest = struct.unpack(">IIBBBBB", data[16:29])
    kind = rng.randrange(3)
    if kind == 0:
        width = rng.choice((0, 1, 12000, 2**31 - 1, width + 1, 65535))
        height = rng.choice((height, 12000, width))
    elif kind == 1:
        height = rng.choice((0, 1, 12000, 2**31 - 1, height + 1))
    else:
        rest[rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    header = b"IHDR" + struct.pack(">IIBBBBB", width % 2**32, height % 2**32, *rest)
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def _zip(data: bytes, rng: random.Random) -> bytes:
    """Change one member of an archive and pack it again; sometimes it inflates to 200 MB."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    if rng.random() < 0.1:
        members[name] = b"[" + b"1," * (1 << 24) if rng.random() < 0.5 else bytes(200 << 20)
    elif rng.random() < 0.15:
        _entry(members, name, rng)
    elif members[name]:
        members[name] = _content(name, members[name], rng)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, content in members.items():
            archive.writestr(key.replace("\0", ""), content)
    result = packed.getvalue()
    if rng.random() < 0.05:  # the flag of encryption
        result = result.replace(b"PK\x01\x02\x14\x03\x14\0\0\0", b"PK\x01\x02\x14\x03\x14\0\1\0")
    return result


def _gzip(data: bytes, rng: random.Random) -> bytes:
    return gzip.compress(_bytes(gzip.decompress(data), rng), 1, mtime=0)


def _npy(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a .npy file."""
    shape = rng.choice(
        ("()", "(-1, 5)", "(1000000, 1000000)", "(0, 0)", "(24, 32, 3)", "(2**3, 4)", "(24, 32", "(9" * 200)
    )
    kind = rng.choice(("<f4", "|O", "<U5", "<c8", "<f8", "|V0", "<i8", "zz"))
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return data[:8] + struct.pack("<H", len(header)) + header + data[128:]


def _safetensors(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a file of tensors, the text in it, or the numbers."""
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    kind = rng.randrange(4)
    name = rng.choice([key for key in header if key != "__metadata__"])
    start, stop = header[name]["data_offsets"]
    if kind == 0:
        header = _changed_tree(header, rng)
    elif kind == 1:
        header[rng.choice(("x", *header))] = header.pop(name)
    elif name == "state":
        body[start:stop] = _state(bytes(body[start:stop]), rng)
    else:
        at = rng.randrange(start, max(start + 1, stop))
        body[start:stop] = rng.choice((b"\xff" * (stop - start), b"\0" * (stop - start), body[start:stop]))
        body[at : at + 8] = rng.choice((struct.pack("<d", float("nan")), struct.pack("<q", 2**62), b"\xff" * 8))
        del body[len(data) - 8 - size :]
    words = json.dumps(header).encode()
    return len(words).to_bytes(8, "little") + words + bytes(body)


def _state(data: bytes, rng: random.Random) -> bytes:
    """Change one value of a state; its length stays, as the header says."""
    changed = json.dumps(_changed_tree(json.loads(data), rng)).encode()
    return changed.ljust(len(data))[: len(data)]


def _ply(data: bytes, rng: random.Random) -> bytes:
    """Change a word of a PLY's header."""
    end = data.index(b"end_header")
    found = list(re.finditer(rb"\S+", data[:end]))
    match = rng.choice(found)
    word = rng.choice((*NUMBERS, "list", "float", "double", "uchar", "vertex", "element", "property", "x")).encode()
    return data[: match.start()] + word + data[match.end() :]
