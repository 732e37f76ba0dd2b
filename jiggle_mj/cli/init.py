"""The verb `init`, which describes a folder of measured points."""

import json
from pathlib import Path

from ..errors import OptionError
from .options import AsJson, PathArgument
from .terminal import console


def refuse_no_folder(path: Path) -> None:
    """Refuse what is no folder where one of measured points is due.

    Raises:
        OptionError: there is no such folder, or it is a file; the message says what to give.
    """
    if not path.exists():
        raise OptionError(f"{path} does not exist; give the folder of the data files.")
    if not path.is_dir():
        raise OptionError(
            f"{path} is a file; give its folder. Is more in it than one recording? Put this one's files into a folder "
            "of their own; 'jiggle-mj init FOLDER' describes them."
        )


def init(folder: PathArgument, /, *, as_json: AsJson = False) -> None:
    """Look at a folder of measured points and write its recording.toml, with comments to check.

    Writes FOLDER/recording.toml and never replaces one; `jiggle-mj import FOLDER --out run.mcap` reads it.

    Args:
        folder: folder of the data files.
        as_json: print the path and what is still refused to stdout as JSON.
    """
    from ..importing.bags.bag_paths import is_bag
    from ..importing.init import describe_folder
    from ..recording.bag_refusal import refuse_bag

    refuse_bag(folder)
    if folder.is_file() and is_bag(folder):
        raise OptionError(f"{folder} needs no recording.toml: 'jiggle-mj inspect {folder}' names the next command.")
    refuse_no_folder(folder)
    description = describe_folder(folder)
    console.print(description.text, highlight=False, soft_wrap=True)
    console.print(f"wrote {description.path}: check the lines above", highlight=False, soft_wrap=True)
    if description.problem is None:
        console.print(f"then: jiggle-mj import {folder} --out run.mcap", highlight=False, soft_wrap=True)
    else:
        console.print(f"an import is still refused: {description.problem}", highlight=False, soft_wrap=True)
    if as_json:
        print(json.dumps({"recording_toml": str(description.path), "problem": description.problem}))
