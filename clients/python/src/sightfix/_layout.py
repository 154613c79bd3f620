"""How imports read their rows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

OnConflict = Literal["keep", "replace"]
BoxForm = Literal["left_top", "centre", "corners"]
BoxUnit = Literal["px", "share"]


@dataclass(frozen=True, kw_only=True)
class CsvLayout:
    """How a CSV file names its columns and writes its boxes."""

    columns: Literal["auto"] | Mapping[str, str] | None = None
    """`auto` finds columns by usual names; a mapping names them by field, such as `{"left": "x1"}`."""
    box_form: BoxForm | None = None
    """The meaning of the columns of a box; by their names if left out."""
    box_unit: BoxUnit | None = None
    """Unit of the sides; pixels if left out."""

    def query(self) -> dict[str, str | None]:
        """The parameters of a request."""
        columns: str | None = None
        if isinstance(self.columns, str):
            columns = self.columns
        elif self.columns is not None:
            columns = ",".join(f"{field}:{column}" for field, column in self.columns.items())
        return {"columns": columns, "box_form": self.box_form, "box_unit": self.box_unit}
