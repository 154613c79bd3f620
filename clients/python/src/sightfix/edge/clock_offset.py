"""Estimates how far a receiver's clock is from the video's, for a video that shows one walker at a time.

For any camera geometry, motion in the image and motion of the fixes agree best at the true offset. Displacements over
some seconds are regressed linearly on differences of box features; the estimate maximises the likelihood, whose
profile over the offset also says how sure it is. Displacements cancel the receiver's slow error. The server estimates
offsets of up to 10 s in the same way; a video's beginning is often known less well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
import numpy.typing as npt

from sightfix.edge.fixes import TimedFix
from sightfix.edge.values import TrackedBox

Numbers = npt.NDArray[np.float64]

BASELINE_S = 5.0
"""Time between the two ends of a displacement."""
STEP_S = 0.5
"""Between rows, and between offsets of the first search."""
FINE_STEP_S = 0.05
SMOOTHING_S = 1.0
MAX_GAP_S = 2.5
"""Fixes are joined over at most this gap, boxes of a target likewise."""
LEAST_ROWS = 60
LEAST_SHARE = 0.7
"""Share of the rows that any offset has."""
OTHER_PEAK_S = 5.0
"""Offsets farther away are another answer."""
EARTH_M_PER_DEG = 111_320.0


@dataclass(frozen=True)
class ClockOffset:
    """An estimated offset, to be added to the receiver's time to get the video's."""

    offset_s: float
    sigma_s: float
    """Standard deviation."""
    margin: float
    """Log-likelihood ratio to the best offset more than 5 s away."""
    explained: float
    """Share of the fixes' displacements that the boxes explain, 0 to 1."""

    @property
    def is_sure(self) -> bool:
        """True if the offset is reliable: within half a second, and no other offset fits as well."""
        return 2 * self.sigma_s <= 1.0 and self.margin >= np.log(100.0)


@dataclass(frozen=True)
class Displacements:
    """Differences of box features between two instants, seconds since the first fix; shape (n,), (n,) and (n, 9)."""

    from_s: Numbers
    to_s: Numbers
    features: Numbers


def estimate_offset(
    boxes: Sequence[tuple[datetime, TrackedBox]],
    fixes: Sequence[TimedFix],
    image_size_px: tuple[int, int],
    window_s: float,
) -> ClockOffset | None:
    """The most likely offset within the window; None if boxes and fixes do not overlap long enough, or nobody moves."""
    if len(fixes) < LEAST_ROWS / 2 or not boxes:
        return None
    origin = fixes[0].time
    displacements = displacements_of(boxes, origin, image_size_px)
    path = Path(fixes, origin)
    coarse = np.arange(-window_s, window_s + STEP_S, STEP_S)
    shares, rows = explained_shares(displacements, path, coarse)
    if not np.isfinite(shares).any():
        return None
    best_s = coarse[np.nanargmax(shares)]
    fine = best_s + np.arange(-2 * STEP_S, 2 * STEP_S + FINE_STEP_S, FINE_STEP_S)
    fine_shares, _ = explained_shares(displacements, path, fine)
    peak = int(np.nanargmax(fine_shares))
    # Displacements overlap: one of two axes is independent per baseline.
    weight = rows.max() * STEP_S / BASELINE_S
    log_likelihoods, coarse_ones = (-weight * np.log1p(-np.minimum(it, 1 - 1e-9)) for it in (fine_shares, shares))
    others = coarse_ones[np.abs(coarse - fine[peak]) > OTHER_PEAK_S]
    others = others[np.isfinite(others)]
    margin = log_likelihoods[peak] - others.max() if others.size else np.inf
    sigma_s = deviation(fine, log_likelihoods, peak)
    return ClockOffset(float(fine[peak]), sigma_s, float(margin), float(fine_shares[peak]))


def displacements_of(
    boxes: Sequence[tuple[datetime, TrackedBox]], origin: datetime, image_size_px: tuple[int, int]
) -> Displacements:
    """Displacements of each target over the baseline, a row per half second."""
    by_target: dict[str, list[tuple[float, Numbers]]] = {}
    for time, box in boxes:
        features = box_features(box, image_size_px)
        by_target.setdefault(box.tracker_id, []).append(((time - origin).total_seconds(), features))
    rows: list[tuple[float, float, Numbers]] = []
    for series in by_target.values():
        steps = averaged(series)
        for step, features in steps.items():
            later = step + round(BASELINE_S / STEP_S)
            if later in steps:
                rows.append((step * STEP_S, later * STEP_S, steps[later] - features))
    from_s, to_s = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    return Displacements(from_s, to_s, np.array([row[2] for row in rows]).reshape(-1, 9))


def box_features(box: TrackedBox, image_size_px: tuple[int, int]) -> Numbers:
    """A linear basis that approximates the perspective view of a plane, of foot point and height."""
    it = box.box
    x = (it.left_px + it.width_px / 2) / image_size_px[0] - 0.5
    y = it.bottom_px / image_size_px[1] - 0.5
    height = it.height_px / image_size_px[1]
    return np.array((x, y, x * y, y * y, x * y * y, y**3, x * x, height, x * height))


def averaged(series: list[tuple[float, Numbers]]) -> dict[int, Numbers]:
    """Means of the features within each step of time."""
    steps: dict[int, list[Numbers]] = {}
    for time_s, features in series:
        steps.setdefault(round(time_s / STEP_S), []).append(features)
    return {step: np.mean(values, axis=0) for step, values in steps.items()}


class Path:
    """The receiver's positions by time: local linear regression with Gaussian weights, none in gaps."""

    def __init__(self, fixes: Sequence[TimedFix], origin: datetime) -> None:
        times_s = np.array([(fix.time - origin).total_seconds() for fix in fixes])
        latitude = np.array([fix.latitude_deg for fix in fixes])
        scale = EARTH_M_PER_DEG * np.cos(np.radians(latitude[0]))
        points = np.stack((np.array([fix.longitude_deg for fix in fixes]) * scale, latitude * EARTH_M_PER_DEG), axis=1)
        points -= points[0]
        self._grid_s = np.arange(times_s[0], times_s[-1], FINE_STEP_S * 2)
        self._points = np.array([smoothed(times_s, points, at_s) for at_s in self._grid_s]).reshape(-1, 2)

    def at(self, times_s: Numbers) -> Numbers:
        """Positions, m east and north; shape (n, 2), not a number where there is none."""
        places = np.rint((times_s - self._grid_s[0]) / (FINE_STEP_S * 2)).astype(int)
        is_inside = (places >= 0) & (places < len(self._grid_s))
        return np.where(is_inside[:, None], self._points[np.clip(places, 0, len(self._grid_s) - 1)], np.nan)


def smoothed(times_s: Numbers, points: Numbers, at_s: float) -> Numbers:
    """The position at an instant; not a number in a gap."""
    after = int(np.searchsorted(times_s, at_s))
    before = after - 1 if after == len(times_s) or times_s[after] > at_s else after
    if before < 0 or after == len(times_s) or times_s[after] - times_s[before] > MAX_GAP_S:
        return np.full(2, np.nan)
    part = slice(*np.searchsorted(times_s, (at_s - 3 * SMOOTHING_S, at_s + 3 * SMOOTHING_S)))
    since_s, near = times_s[part] - at_s, points[part]
    weights = np.exp(-0.5 * (since_s / SMOOTHING_S) ** 2)
    mean_s = np.average(since_s, weights=weights)
    mean = np.average(near, axis=0, weights=weights)
    spread = np.average((since_s - mean_s) ** 2, weights=weights)
    if spread <= 0:
        return np.asarray(mean)
    slope = np.average((since_s - mean_s)[:, None] * (near - mean), axis=0, weights=weights) / spread
    return np.asarray(mean - slope * mean_s)


def explained_shares(displacements: Displacements, path: Path, offsets_s: Numbers) -> tuple[Numbers, Numbers]:
    """R^2 of the regression at each offset, not a number with too few rows; and the number of rows."""
    counts, shares = np.zeros(len(offsets_s)), np.full(len(offsets_s), np.nan)
    for index, offset_s in enumerate(offsets_s):
        moved = path.at(displacements.to_s - offset_s) - path.at(displacements.from_s - offset_s)
        valid = np.isfinite(moved[:, 0])
        counts[index] = valid.sum()
        if counts[index] >= LEAST_ROWS:
            shares[index] = explained_share(displacements.features[valid], moved[valid])
    shares[counts < LEAST_SHARE * counts.max()] = np.nan
    return shares, counts


def explained_share(features: Numbers, moved: Numbers) -> float:
    """R^2 of displacements on features; not a number if nobody moves."""
    total = float((moved**2).sum())
    if total < 0.25 * len(moved):
        return np.nan
    solved, *_ = np.linalg.lstsq(features, moved, rcond=1e-9)
    return 1 - float(((moved - features @ solved) ** 2).sum()) / total


def deviation(offsets_s: Numbers, log_likelihoods: Numbers, peak: int) -> float:
    """Standard deviation by the curvature of a parabola through the surroundings of the peak."""
    part = slice(max(0, peak - 6), peak + 7)
    near = np.isfinite(log_likelihoods[part])
    curvature = np.polyfit(offsets_s[part][near] - offsets_s[peak], log_likelihoods[part][near], 2)[0]
    return float(np.sqrt(-0.5 / curvature)) if curvature < 0 else np.inf


def shifted(time: datetime, offset: ClockOffset) -> datetime:
    """A time of the video by the receiver's clock."""
    return time - timedelta(seconds=offset.offset_s)
