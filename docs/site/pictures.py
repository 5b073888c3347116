"""Runs the examples and keeps their pictures, small, in docs/examples/: `make pictures`."""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "examples"
WIDTH = 900
COLOURS = 64


def keep(picture: Path) -> None:
    """Writes a picture with fewer colours, and no wider than a page."""
    image = Image.open(picture).convert("RGB")
    image.thumbnail((WIDTH, 10 * WIDTH))
    image.quantize(COLOURS).save(FOLDER / picture.name, optimize=True)


def main(names: list[str]) -> None:
    """Runs the named examples, or all."""
    FOLDER.mkdir(exist_ok=True)
    for example in sorted((ROOT / "examples").glob("*.py")):
        if names and example.stem not in names:
            continue
        with TemporaryDirectory() as folder:
            subprocess.run([sys.executable, str(example)], cwd=folder, check=True)
            keep(Path(folder) / f"{example.stem}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
