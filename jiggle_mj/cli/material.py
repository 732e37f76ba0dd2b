"""An identified material as a table with sentences, and as JSON."""

from dataclasses import asdict
from typing import Any

from rich.table import Table

from ..material import Material
from .terminal import console


def show_material(material: Material) -> None:
    """Print the ratios, what is not identified and why, and the declaration that follows."""
    table = Table(
        "over the membrane stiffness", "unit", "declared", "identified", "standard error", "correlates with", box=None
    )
    for name, ratio in material.ratios.items():
        factor = ratio.factor
        cells = ("-", "-") if factor is None else (f"{ratio.declared * factor:.3g}", f"{100 * ratio.log_sd:.1f} %")
        table.add_row(
            name, ratio.unit, f"{ratio.declared:.3g}", *cells, f"{ratio.trades_with} ({ratio.correlation:.2f})"
        )
    console.print(table)
    for name, why in material.refused.items():
        console.print(f"{name}: not identified; {why}.", highlight=False)
    if any(ratio.refused is None for ratio in material.ratios.values()):
        declaration = material.declaration
        console.print(
            f"If the sheet weighs the declared {declaration.areal_density:g} kg/m^2: membrane_stiffness = "
            f"{declaration.membrane_stiffness:.3g} N/m, and thickness = {declaration.thickness:.3g} m for its bending.",
            highlight=False,
        )


def material_json(material: Material) -> dict[str, Any]:
    """Return the content of --json."""
    ratios = {name: asdict(ratio) for name, ratio in material.ratios.items()}
    names = ("membrane_stiffness", "thickness", "areal_density")
    identified = {name: getattr(material.declaration, name) for name in names}
    return {"ratios": ratios, "refused": material.refused, "declaration": identified}
