"""Draw the pictures of docs/MEASURED.md from folders that close-loop wrote: docs/images/NAME.webp of each FOLDER/NAME.

Run it in the project's folder: .venv/bin/python tools/draw_measured.py out/skin_1013 out/lift_4
"""

import sys
from pathlib import Path

from jiggle_mj.eval.report.sheet_picture import write_sheet_picture

OUT = Path("docs/images")

if __name__ == "__main__":
    for folder in map(Path, sys.argv[1:]):
        write_sheet_picture(folder, OUT / f"{folder.name}.webp", title=folder.name.replace("_", " "))
