"""Positions of finished tracks."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sightfix._async.transport import Transport
from sightfix._request import Request, delete, get
from sightfix._tables import history_columns, to_frame, to_geo_frame
from sightfix.models import DeletedHistory

if TYPE_CHECKING:
    import pandas as pd

FORMATS = {
    ".csv": "csv",
    ".ndjson": "ndjson",
    ".geojson": "geojson",
    ".parquet": "geoparquet",
    ".mfjson": "moving_features",
    ".txt": "mot",
}
PATH = "/v1/history"


class History:
    """Positions of finished tracks of a camera or a site whose profile has a `history`.

    Args of all methods, of which `camera` or `site` is needed:
        camera: The camera whose tracks are meant.
        site: The site whose world tracks are meant.
        from_: From this instant on.
        until: Before this instant.
        bbox: West, south, east and north in degrees.
        place: A place of that camera or site, an area or a disc; not beside `bbox`.
        class_: Class of the targets.
        target_id: The target.
        receiver_id: A receiver that the target carries.
        track_id: The track.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def to_frame(self, **selection: Any) -> pd.DataFrame:
        """Positions as a DataFrame by time and track; as a GeoDataFrame if geopandas is installed."""
        rows = []
        async with self._transport.open(selected(selection, "ndjson")) as response:
            async for line in response.aiter_lines():
                rows.append(json.loads(line))
        return to_geo_frame(to_frame(history_columns(rows)))

    async def export(
        self,
        file: str | Path,
        *,
        origin: tuple[float, float] | None = None,
        frame_hz: float | None = None,
        **selection: Any,
    ) -> None:
        """Writes positions to a file as CSV, NDJSON, GeoJSON, GeoParquet, Moving Features JSON or MOTChallenge.

        The ending of its name says which: `.csv`, `.ndjson`, `.geojson`, `.parquet`, `.mfjson` or `.txt`.

        Args:
            file: The file.
            origin: Longitude and latitude that MOTChallenge's x and y are counted from.
            frame_hz: MOTChallenge's frames per second, of which frame 1 is at `from_`.
            selection: As of the other methods.

        Raises:
            ValueError: The name has another ending.
        """
        file = Path(file)
        if file.suffix not in FORMATS:
            raise ValueError(f"{file.name} must end in {', '.join(FORMATS)}")
        request = selected(selection, FORMATS[file.suffix])
        frames = {"origin": None if origin is None else ",".join(map(str, origin)), "frame_hz": frame_hz}
        async with self._transport.open(replace(request, query={**request.query, **frames})) as response:
            with file.open("wb") as output:  # noqa: ASYNC230, short writes of what has arrived
                async for part in response.aiter_bytes():
                    output.write(part)

    async def heat_map(self, *, cell_m: float = 1.0, **selection: Any) -> dict[str, Any]:
        """Where targets spent their time: cells of a grid on the ground as GeoJSON features.

        Each has the properties `seconds`, of all targets together, and `visits`, how often a track came into it.

        Args:
            cell_m: Extent of a cell, m.
            selection: As of the other methods.
        """
        query = {**query_of(**selection), "cell_m": cell_m}
        request = replace(get(f"{PATH}/heat-map"), query=query)
        features: dict[str, Any] = (await self._transport.send(request)).json()
        return features

    async def delete(self, **selection: Any) -> int:
        """Deletes positions in every file of the server, and returns their number."""
        request = replace(delete(PATH), query=query_of(**selection))
        return (await self._transport.json(request, DeletedHistory)).deleted


def selected(selection: dict[str, Any], form: str) -> Request:
    """Asks for the positions of a selection as a file."""
    query = {**query_of(**selection), "format": form}
    return Request(method="GET", path=PATH, query=query, headers={}, is_idempotent=True)


def query_of(
    *,
    camera: str | None = None,
    site: str | None = None,
    from_: datetime | None = None,
    until: datetime | None = None,
    bbox: tuple[float, float, float, float] | None = None,
    place: str | None = None,
    class_: str | None = None,
    target_id: str | None = None,
    receiver_id: str | None = None,
    track_id: str | None = None,
) -> dict[str, Any]:
    """The query of a selection."""
    return {
        "camera": camera,
        "site": site,
        "from": from_,
        "until": until,
        "place": place,
        "bbox": None if bbox is None else ",".join(str(degrees) for degrees in bbox),
        "class": class_,
        "target_id": target_id,
        "receiver_id": receiver_id,
        "track_id": track_id,
    }
