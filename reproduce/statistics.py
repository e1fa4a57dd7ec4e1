"""Means over seeds with their 95 % intervals, bins of environment steps, and when a curve reaches a threshold."""

from __future__ import annotations

from typing import Sequence

import numpy as np
from scipy.stats import t as student

from dae_ros.report.learning_curve import smoothed

CONFIDENCE = 0.95
END_SHARE = 0.05  # of a training, over which its last return is averaged


def mean_and_interval(groups: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean [...] over the groups' means, and half the width [...] of its 95 % interval; nan where a group has one seed only.

    groups: values [seeds, ...] of each team size, with any number of seeds. With one group this is Student's interval of a
    mean; with several, whose spreads differ, the degrees of freedom are those of Welch and Satterthwaite.
    """
    mean = np.mean([group.mean(0) for group in groups], axis=0)
    if min(map(len, groups)) < 2:
        return mean, np.full_like(mean, np.nan)
    # Variance of each group's mean, as it enters the mean over the groups.
    parts = np.array([group.var(0, ddof=1) / len(group) for group in groups]) / len(groups) ** 2
    freedom = np.array([len(group) - 1 for group in groups]).reshape(-1, *[1] * mean.ndim)
    total = parts.sum(0)
    smallest = np.finfo(float).tiny  # seeds that agree exactly have an interval of width 0
    effective = np.maximum(total ** 2, smallest) / np.maximum((parts ** 2 / freedom).sum(0), smallest)
    return mean, student.ppf((1 + CONFIDENCE) / 2, effective) * np.sqrt(total)


def binned(steps: np.ndarray, values: np.ndarray, width: int) -> np.ndarray:
    """Means [bins] of `values` [rows] over `width` environment steps each, given the `steps` [rows] at the end of every row.

    Rows without a number are left out, and so is a last bin that is not full. Fewer steps than one bin make one.
    """
    bins = max(1, int(steps[-1]) // width)
    place = np.minimum(np.ceil(steps / width), bins + 1).astype(int) - 1 if steps[-1] >= width else np.zeros(len(steps), int)
    known = np.isfinite(values) & (place < bins)
    count, total = (np.bincount(place[known], weights, minlength=bins) for weights in (None, values[known]))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def steps_to_reach(threshold: float, steps: np.ndarray, values: np.ndarray) -> float | None:
    """The first of `steps` [rows] at which `values` [rows], smoothed, are at the threshold or above; None if they never are."""
    reached = np.flatnonzero(smoothed(values) >= threshold)
    return float(steps[reached[0]]) if len(reached) else None


def last(values: np.ndarray) -> float:
    """Mean over the last part of a training."""
    return float(np.mean(values[-max(1, round(END_SHARE * len(values))):]))
