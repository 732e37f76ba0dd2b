"""Options that several verbs share, as tyro reads them."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

PathArgument = Annotated[Path, tyro.conf.Positional]
Name = Annotated[str, tyro.conf.Positional]
RowsName = Literal["inside", "together", "images", "outside", "nothing"]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
AsJson = Annotated[bool, tyro.conf.arg(name="json")]
Disturb = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[=MAGNITUDE]")]]
