"""`benchmarks/results.json`: what the benchmarks measured last, each under a key of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Mapping

from dae_ros.files import write_atomically

FILE = Path(__file__).with_name('results.json')


def merge(key: str, result: Mapping[str, Any], path: Path = FILE) -> None:
    """Replaces what `path` holds under `key` by `result`, and leaves the rest as it is."""
    results = json.loads(path.read_text(encoding='utf-8')) if path.exists() else {}
    results[key] = result
    write_atomically(path, (json.dumps(results, indent=2, sort_keys=True) + '\n').encode())
