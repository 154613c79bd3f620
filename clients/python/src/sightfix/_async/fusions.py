"""Positions of single observations."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from sightfix._async.transport import Transport
from sightfix._json import to_json
from sightfix._request import in_chunks, path, with_json
from sightfix._tables import Table, fusion_columns, observation_rows, to_arrays, to_frame
from sightfix.models import FusedFix, Observation
from sightfix.models import Fusions as FusionPage

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

OBSERVATIONS_PER_REQUEST = 1000


class Fusions:
    """Fuses boxes and fixes into positions. Nothing is stored."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    async def fuse(self, camera_id: str, observation: Observation) -> FusedFix:
        """The position of one observation."""
        return (await self._fuse(camera_id, [to_json(observation)]))[0]

    async def fuse_batch(self, camera_id: str, observations: Iterable[Observation]) -> list[FusedFix]:
        """The positions of many observations, in their order; 1,000 in a request."""
        return [fused async for fused in self._fuse_rows(camera_id, map(to_json, observations))]

    async def fuse_arrays(self, camera_id: str, columns: Table) -> dict[str, np.ndarray[Any, Any]]:
        """The positions of observations given as arrays by column, as arrays by column.

        Needs the extra `numpy`. Columns in: `time`, optional `target_id`, `left_px`, `top_px`, `width_px`, `height_px`,
        `longitude_deg`, `latitude_deg`, `sigma_m`; NaN where an observation has no box or no fix. Columns out:
        `longitude_deg`, `latitude_deg`, `r95_m`, `covariance_east_m2`, `covariance_north_m2`,
        `covariance_east_north_m2`, `regressed_longitude_deg`, `regressed_latitude_deg`, `confidence_regression`,
        `confidence_gnss`, `e_regression_m2`, `e_gnss_m2`, `reconstruction_error`, `model_version` and
        `position_flags` (separated by spaces).

        Raises:
            ValueError: A column is unknown, or a time has no UTC offset.
        """
        rows = observation_rows(columns)
        return to_arrays(fusion_columns([fused async for fused in self._fuse_rows(camera_id, rows)]))

    async def fuse_frame(self, camera_id: str, frame: pd.DataFrame) -> pd.DataFrame:
        """The positions of the observations in a frame, with the frame's index; columns as in `fuse_arrays`.

        Needs the extra `pandas`.
        """
        rows = observation_rows(frame)
        fusions = [fused async for fused in self._fuse_rows(camera_id, rows)]
        return to_frame(fusion_columns(fusions), index=frame.index)

    async def _fuse_rows(self, camera_id: str, rows: Iterable[Mapping[str, Any]]) -> AsyncIterator[FusedFix]:
        for chunk in in_chunks(rows, OBSERVATIONS_PER_REQUEST):
            for fused in await self._fuse(camera_id, chunk):
                yield fused

    async def _fuse(self, camera_id: str, observations: list[Any]) -> list[FusedFix]:
        request = with_json(
            "POST", path("cameras", camera_id, "fusions"), {"observations": observations}, is_idempotent=True
        )
        return (await self._transport.json(request, FusionPage)).items
