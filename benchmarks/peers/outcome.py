"""What the turns of a match come to: medians, ratios, and whether the machine was quiet."""

from __future__ import annotations

from statistics import median
from typing import Any, Mapping, NamedTuple

from benchmarks.machine import QUIET
from benchmarks.peers.contender import Block
from benchmarks.peers.match import Comparison, Match


class Row(NamedTuple):
    """One contender's turns."""

    name: str
    versions: Mapping[str, str]
    blocks: tuple[Block, ...]

    @property
    def median(self) -> float:
        return median(block.speed for block in self.blocks)

    @property
    def slowest(self) -> float:
        return min(block.speed for block in self.blocks)

    @property
    def fastest(self) -> float:
        return max(block.speed for block in self.blocks)


class Ratio(NamedTuple):
    """A comparison's result: ours over the fastest of those present."""

    ours: str
    other: str
    value: float
    target: float | None

    @property
    def verdict(self) -> str:
        if self.target is None:
            return ''
        return f'{"reached" if self.value >= self.target else "missed"}: at least {self.target:.1f}'


class Outcome(NamedTuple):
    """One match, played."""

    title: str
    rows: tuple[Row, ...]
    ratios: tuple[Ratio, ...]

    def table(self) -> str:
        lines = [f'{self.title:50}{"median":>12}{"slowest":>12}{"fastest":>12}   [environment steps per second]']
        lines += [f'  {row.name:48}{row.median:12,.0f}{row.slowest:12,.0f}{row.fastest:12,.0f}' for row in self.rows]
        for ratio in self.ratios:
            lines.append(f'  {f"{ratio.ours} / {ratio.other}":48}{ratio.value:12.2f}   {ratio.verdict}'.rstrip())
        return '\n'.join(lines)

    def record(self) -> dict[str, Any]:
        """As it goes into results.json."""
        return {'title': self.title,
                'rows': [{'name': row.name, 'versions': dict(row.versions), 'median': round(row.median),
                          'rounds': [round(block.speed) for block in row.blocks],
                          'cores_of_others': [round(block.bystanders, 2) for block in row.blocks]} for row in self.rows],
                'ratios': [{**ratio._asdict(), 'value': round(ratio.value, 3)} for ratio in self.ratios]}


def outcome(match: Match, rows: tuple[Row, ...]) -> Outcome:
    """rows: of the contenders that came through, which may be fewer than were to play."""
    medians = {row.name: row.median for row in rows}
    return Outcome(match.title, rows, tuple(filter(None, (_ratio(comparison, medians) for comparison in match.comparisons))))


def _ratio(comparison: Comparison, medians: Mapping[str, float]) -> Ratio | None:
    present = [name for name in comparison.others if name in medians]
    if comparison.ours not in medians or not present:
        return None
    best = max(present, key=medians.get)
    return Ratio(comparison.ours, best, medians[comparison.ours] / medians[best], comparison.target)


def disturbance(outcomes: list[Outcome]) -> str:
    """A sentence on what other processes did meanwhile; empty when the machine was quiet."""
    cores = [block.bystanders for played in outcomes for row in played.rows for block in row.blocks]
    disturbed = sum(busy > QUIET for busy in cores)
    if not disturbed:
        return ''
    return (f'The machine was not quiet: in {disturbed} of {len(cores)} turns other processes kept more than {QUIET} cores busy, '
            f'{max(cores):.1f} at most. Take the figures with care.')
