"""What is kept: docs/results/<figure>.csv and .png, the tables in docs/results.md, and the records of the runs."""

from __future__ import annotations

from pathlib import Path
from typing import Iterable

from reproduce.curves import Curves
from reproduce.draw import draw
from reproduce.figures import Figure
from reproduce.records import Records
from reproduce.tables import figure_block, write_block


def results_folder(docs: Path) -> Path:
    """Where all but the tables lie."""
    return docs / 'results'


def write_results(figures: Iterable[Figure], records: Records, docs: Path) -> None:
    """Writes every figure anew that has a finished run."""
    results = results_folder(docs)
    results.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        for run in figure.all_runs():
            records.keep(run)
        curves = Curves(figure, records)
        if any(curves.seeds.values()):
            curves.write_csv(results / f'{figure.name}.csv')
            draw(curves, results / f'{figure.name}.png')
            write_block(docs / 'results.md', figure.name, figure_block(curves, records))
