"""A figure of the tests' own, and runs for it that nobody trained."""

from __future__ import annotations

import json

from dae_ros import settings_yaml
from dae_ros.report.metrics import MetricsLog
from reproduce.records import finished_file

DECLARED = '''
teams: {navigation: {3: {seeds: 2, steps: 6400}, 4: {seeds: 2, steps: 6400}}, line: {3: {seeds: 3, steps: 6400}}}
curves: {'low': {beta: 0.0}, 'high': {beta: 1.0}}
figures: {x: {title: Some tasks, shows: mean_return, curves: [low, high], average: true, baseline: low, threshold: 5}}
'''


def pretend_run(run, records, level):
    """Leaves what a training leaves; returns a shell command that does nothing more."""
    path = records.path(run)
    log = MetricsLog(path)
    (path / 'settings.yaml').write_text(settings_yaml.dump(run.settings))
    for update in range(1, run.updates + 1):
        log.write(update * run.steps_per_update, {'mean_return': level + update, 'advantage/deviation': 1.0,
                                                  'seconds/collecting': 0.5, 'seconds/learning': 1.5})
    log.close()
    facts = {'environment_steps': run.steps, 'seconds': 3600.0, 'evaluation_return': level, 'versions': {'python': '3'},
             'machine': {'processor': 'abacus', 'cores': 2, 'system': 'wood', 'commit': 'abc'}, 'settings': {'num_agents': 3}}
    finished_file(path, run.steps).write_text(json.dumps(facts))
    return 'true'
