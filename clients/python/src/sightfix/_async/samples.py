"""Samples for training."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sightfix._async.transport import Transport
from sightfix._json import dump, to_json
from sightfix._layout import CsvLayout, OnConflict
from sightfix._request import Request, delete, get, idempotency, in_chunks, path
from sightfix._tables import Table, sample_columns, sample_rows, to_arrays, to_frame
from sightfix.models import (
    DeletedSamples,
    Durability,
    Imported,
    PairedSamples,
    Sample,
    SampleCount,
)

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

MEDIA_TYPES = {
    ".csv": "text/csv",
    ".ndjson": "application/x-ndjson",
    ".jsonl": "application/x-ndjson",
    ".json": "application/json",
    ".geojson": "application/geo+json",
}
ROWS_PER_REQUEST = 20_000


class Samples:
    """Stored boxes and fixes, from which cameras are trained.

    Importing the same rows again does no harm: what is stored already is counted as `duplicate`.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def import_file(
        self,
        camera_id: str,
        file: str | Path,
        *,
        durability: Durability = "synced",
        on_conflict: OnConflict = "keep",
        layout: CsvLayout | None = None,
        target_id: str | None = None,
        idempotency_key: str | None = None,
    ) -> Imported:
        """Imports a file of CSV, NDJSON or JSON, by its name's ending.

        `line` of a rejected row is the line of the file.

        Args:
            camera_id: The camera.
            file: The file.
            durability: When the samples are acknowledged.
            on_conflict: Whether a sample replaces a stored one of the same target and time.
            layout: Columns of a CSV file; the documented ones by default.
            target_id: The target of a CSV file that names none.
            idempotency_key: The same import under the same key gets the answer of the first, for a day.

        Raises:
            ValueError: The name has another ending.
        """
        file = Path(file)
        request = Request(
            method="POST",
            path=path("cameras", camera_id, "samples"),
            query={
                "durability": durability,
                "on_conflict": on_conflict,
                "target_id": target_id,
                **(layout or CsvLayout()).query(),
            },
            headers={"content-type": media_type(file), **idempotency(idempotency_key)},
            body=file,
            is_idempotent=True,
        )
        return await self._transport.json(request, Imported)

    async def import_samples(
        self,
        camera_id: str,
        samples: Iterable[Sample],
        *,
        durability: Durability = "synced",
        on_conflict: OnConflict = "keep",
    ) -> Imported:
        """Imports samples in requests of 20,000. `line` of a rejected row counts the samples from 1."""
        rows = (to_json(sample) for sample in samples)
        return await self._import_rows(camera_id, rows, durability, on_conflict)

    async def import_table(
        self,
        camera_id: str,
        table: Table,
        *,
        durability: Durability = "synced",
        on_conflict: OnConflict = "keep",
    ) -> Imported:
        """Imports the columns of a pandas DataFrame, or a mapping of names to arrays.

        The columns are those of a CSV file, with or without their units: `time`, `target_id`, `left_px`, `top_px`,
        `width_px`, `height_px`, `longitude_deg`, `latitude_deg`; optional are `sigma_m`, `class`, `score`,
        `truth_longitude_deg` and `truth_latitude_deg`. Times are RFC 3339 or have a time zone; `datetime64` of
        numpy is UTC. A row that the server rejects does not affect the others; its `line` counts the rows from 1.

        Raises:
            ValueError: A column is unknown, or a time has no UTC offset.
        """
        return await self._import_rows(camera_id, sample_rows(table), durability, on_conflict)

    async def pair_files(
        self,
        camera_id: str,
        detections: str | Path,
        fixes: str | Path,
        *,
        method: Literal["nearest", "interpolate"] | None = None,
        window_s: float | None = None,
        longest_gap_s: float | None = None,
        target_id: str | None = None,
        receiver_id: str | None = None,
        keep_unpaired: bool | None = None,
        estimate_offset: bool | None = None,
        match: bool | None = None,
        min_probability: float | None = None,
        clock_window_s: float | None = None,
        durability: Durability | None = None,
        on_conflict: OnConflict | None = None,
        layout: CsvLayout | None = None,
        idempotency_key: str | None = None,
    ) -> PairedSamples:
        """Pairs boxes and fixes that were recorded apart by time, and stores the pairs.

        Args:
            camera_id: The camera.
            detections: Boxes as CSV or NDJSON.
            fixes: Fixes as CSV, NMEA, GPX, FIT, solutions of RTKLIB, a log of GnssLogger or reports of gpsd.
            method: `nearest` by default.
            window_s: Box and fix are at most this far apart (nearest).
            longest_gap_s: Fixes are joined over at most this long a gap (interpolate).
            target_id: The target of boxes that name none.
            receiver_id: The receiver of fixes that name none.
            keep_unpaired: Store boxes without a fix as samples without one.
            estimate_offset: Estimate the clock offsets of the receivers; they are not applied.
            match: Find out whose boxes show whose receivers; boxes then need only a tracker's ids.
            min_probability: Leave out samples whose match is less probable.
            clock_window_s: The receivers' clocks are off by at most this, for `match`.
            durability: When the samples are acknowledged.
            on_conflict: Whether a sample replaces a stored one of the same target and time.
            layout: Columns of CSV files; the documented ones by default.
            idempotency_key: The same import under the same key gets the answer of the first, for a day.
        """
        request = Request(
            method="POST",
            path=path("cameras", camera_id, "samples", "pairings"),
            query={
                "method": method,
                "window_s": window_s,
                "longest_gap_s": longest_gap_s,
                "target_id": target_id,
                "receiver_id": receiver_id,
                "keep_unpaired": keep_unpaired,
                "estimate_offset": estimate_offset,
                "match": match,
                "min_probability": min_probability,
                "clock_window_s": clock_window_s,
                "durability": durability,
                "on_conflict": on_conflict,
                **(layout or CsvLayout()).query(),
            },
            headers=idempotency(idempotency_key),
            files={"detections": Path(detections), "fixes": Path(fixes)},
            is_idempotent=True,
        )
        return await self._transport.json(request, PairedSamples)

    def list(
        self,
        camera_id: str,
        *,
        from_: datetime | None = None,
        until: datetime | None = None,
        target_id: str | None = None,
        has_fix: bool | None = None,
        page_size: int | None = None,
    ) -> AsyncIterator[Sample]:
        """Samples by time and target."""
        return self._transport.items(
            path("cameras", camera_id, "samples"),
            Sample,
            from_=from_,
            until=until,
            target_id=target_id,
            has_fix=has_fix,
            limit=page_size,
        )

    async def to_arrays(self, camera_id: str, **selection: Any) -> dict[str, np.ndarray[Any, Any]]:
        """Samples as numpy arrays by column; the arguments are those of `list`."""
        return to_arrays(sample_columns([sample async for sample in self.list(camera_id, **selection)]))

    async def to_frame(self, camera_id: str, **selection: Any) -> pd.DataFrame:
        """Samples as a pandas DataFrame; the arguments are those of `list`."""
        return to_frame(sample_columns([sample async for sample in self.list(camera_id, **selection)]))

    async def export(
        self,
        camera_id: str,
        file: str | Path,
        *,
        from_: datetime | None = None,
        until: datetime | None = None,
        target_id: str | None = None,
        has_fix: bool | None = None,
    ) -> None:
        """Writes samples to a file as CSV, NDJSON or GeoJSON, by its name's ending.

        Raises:
            ValueError: The name has another ending.
        """
        file = Path(file)
        request = Request(
            method="GET",
            path=path("cameras", camera_id, "samples"),
            query={"from": from_, "until": until, "target_id": target_id, "has_fix": has_fix},
            headers={"accept": media_type(file)},
            is_idempotent=True,
        )
        async with self._transport.open(request) as response:
            with file.open("wb") as output:  # noqa: ASYNC230, short writes of what has arrived
                async for part in response.aiter_bytes():
                    output.write(part)

    async def count(
        self,
        camera_id: str,
        *,
        from_: datetime | None = None,
        until: datetime | None = None,
        target_id: str | None = None,
        has_fix: bool | None = None,
    ) -> SampleCount:
        """How many samples there are."""
        request = get(
            path("cameras", camera_id, "samples", "count"),
            from_=from_,
            until=until,
            target_id=target_id,
            has_fix=has_fix,
        )
        return await self._transport.json(request, SampleCount)

    async def delete(
        self,
        camera_id: str,
        *,
        from_: datetime | None = None,
        until: datetime | None = None,
        target_id: str | None = None,
        has_fix: bool | None = None,
    ) -> int:
        """Deletes the selected samples; returns how many there were. The selection must not be empty."""
        request = delete(
            path("cameras", camera_id, "samples"),
            from_=from_,
            until=until,
            target_id=target_id,
            has_fix=has_fix,
        )
        return (await self._transport.json(request, DeletedSamples)).deleted

    async def _import(
        self, camera_id: str, rows: Sequence[Mapping[str, Any]], durability: Durability, on_conflict: OnConflict
    ) -> Imported:
        request = Request(
            method="POST",
            path=path("cameras", camera_id, "samples"),
            query={"durability": durability, "on_conflict": on_conflict},
            headers={"content-type": MEDIA_TYPES[".ndjson"]},
            body=b"\n".join(dump(row) for row in rows),
            is_idempotent=True,
        )
        return await self._transport.json(request, Imported)

    async def _import_rows(
        self, camera_id: str, rows: Iterable[Mapping[str, Any]], durability: Durability, on_conflict: OnConflict
    ) -> Imported:
        imported: Imported | None = None
        rows_before = 0
        for chunk in in_chunks(rows, ROWS_PER_REQUEST):
            part = await self._import(camera_id, chunk, durability, on_conflict)
            imported = part if imported is None else added(imported, part, rows_before)
            rows_before += len(chunk)
        # Without rows the server says what no rows become.
        return imported or await self._import(camera_id, [], durability, on_conflict)


def added(imported: Imported, part: Imported, rows_before: int) -> Imported:
    """One report of an import that took several requests; the rows of `part` come after `rows_before` others."""
    counts = {
        it.name: getattr(imported, it.name) + getattr(part, it.name)
        for it in fields(Imported)
        if isinstance(getattr(part, it.name), int)
    }
    rejected = [replace(row, line=rows_before + row.line) for row in part.rejected_rows]
    return replace(imported, rejected_rows=[*imported.rejected_rows, *rejected], **counts)


def media_type(file: Path) -> str:
    """The media type of a file by the ending of its name."""
    try:
        return MEDIA_TYPES[file.suffix.lower()]
    except KeyError:
        endings = ", ".join(MEDIA_TYPES)
        raise ValueError(f"the name of {file} must end with one of {endings}") from None
