"""Put pictures into a page, so that it is one file that can be sent."""

import base64
import io
from pathlib import Path

from PIL import Image

from sigmasplat.errors import RunError

QUALITY = 86


def data_uri(path: Path, lossless: bool = False) -> str:
    """Return a picture as a data: URI, WebP. Raises RunError if it cannot be read."""
    try:
        with Image.open(path) as picture:
            buffer = io.BytesIO()
            picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, lossless=lossless)
    except OSError as problem:
        raise RunError(f"cannot read picture {path}: {problem}") from problem
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
