"""The corrected model as files: a declaration to estimate with, and parameters as MuJoCo's `sysid` toolbox has them.

`parameters.yaml` is what `mujoco.sysid.ParameterDict.save_to_disk` of MuJoCo 4.0 writes and `load_from_disk` reads: by
name, the name again, `nominal`, `min_value`, `max_value`, `value` and `frozen`, numbers as lists.
"""

from pathlib import Path

from jiggle_mj.estimator.attribution.corrected import CorrectedParameter, corrected_declaration
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.declaration_file import declaration_text
from jiggle_mj.recording.output_files import write_text

CORRECTED, PARAMETERS = "corrected.toml", "parameters.yaml"
"""Names of the two files."""
CORRECTED_JOINT = "corrected_joint.toml"
"""Name of the declaration where several recordings share the effects of the tissue."""


def write_corrected(
    directory: Path, added: dict[str, CorrectedParameter], declaration: Declaration, *, name: str
) -> None:
    """Write the corrected model of the recording `name` into a folder: what is declared, and what close-loop added.

    Raises:
        OutputError: a file cannot be written.
    """
    write_text(directory / CORRECTED, corrected_text(added, declaration, name=name, file=CORRECTED))
    write_text(directory / PARAMETERS, parameters_text(added))


def corrected_text(added: dict[str, CorrectedParameter], declaration: Declaration, *, name: str, file: str) -> str:
    """Return the corrected model of the recording `name` as the text of a file of a declaration."""
    corrected = corrected_declaration(added, declaration)
    effects = {effect.name: effect for effect in (*LIBRARY, *(one.effect for one in added.values()))}
    about = [
        f"What is declared of {' '.join(name.split())}, with the effects of docs/EFFECTS.md that close-loop has added.",
        f"jiggle-mj estimate RECORDING --declare {file} estimates with it.",
    ]
    notes = {key: _note(effects[key.partition(".")[0]]) for key in corrected.effects}
    return declaration_text(corrected, about=about, notes=notes)


def parameters_text(parameters: dict[str, CorrectedParameter]) -> str:
    """Return the parameters of the added effects as the text of `parameters.yaml`."""
    lines = list[str]()
    for name, one in parameters.items():
        lines += [f"{name}:", f"  name: {name}"]
        for key in ("nominal", "min_value", "max_value", "value"):
            lines.append(f"  {key}: [{', '.join(map(_number, getattr(one, key)))}]")
        lines.append("  frozen: false")
    return "\n".join(lines or ["{}"]) + "\n"


def _number(value: float) -> str:
    """Return a number in YAML 1.1, where an exponent needs a decimal point before it."""
    mantissa, e, exponent = repr(value).partition("e")
    return mantissa + (".0" if e and "." not in mantissa else "") + e + exponent


def _note(effect: Effect) -> str:
    units = ", ".join(unit or "1" for unit in effect.units)
    if effect.sensing:
        units += "; of the tool, camera or tracker: holds for this session alone"
    return units + ("; an estimate cannot have it" if effect.needs_later_reports else "")
