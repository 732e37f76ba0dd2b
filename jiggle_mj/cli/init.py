"""The verb `init`, which describes a folder of measured points."""

import json
from pathlib import Path

from .options import AsJson, PathArgument
from .terminal import console


def init(folder: PathArgument, /, *, as_json: AsJson = False) -> None:
    """Look at a folder of measured points and write its recording.toml, with comments to check.

    Writes FOLDER/recording.toml and never replaces one; `jiggle-mj import FOLDER --out run.mcap` reads it.

    Args:
        folder: folder of the data files.
        as_json: print the path and what is still refused to stdout as JSON.
    """
    from ..importing.init import describe_folder

    description = describe_folder(Path(folder))
    console.print(description.text, highlight=False, soft_wrap=True)
    console.print(f"wrote {description.path}: check the lines above", highlight=False, soft_wrap=True)
    if description.problem is None:
        console.print(f"then: jiggle-mj import {folder} --out run.mcap", highlight=False, soft_wrap=True)
    else:
        console.print(f"an import is still refused: {description.problem}", highlight=False, soft_wrap=True)
    if as_json:
        print(json.dumps({"recording_toml": str(description.path), "problem": description.problem}))
