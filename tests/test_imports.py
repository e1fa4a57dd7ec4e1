"""Who may import what: read from the source of every Python file, and tried where it matters to a robot."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent
NOT_OURS = {'build', 'install', 'log', 'runs'}  # what set-up and runs leave, beside hidden folders

ROS = {'rclpy', 'dae_ros_msgs', 'rcl_interfaces', 'launch', 'launch_ros', 'ament_index_python', 'std_msgs', 'std_srvs',
       'geometry_msgs', 'nav_msgs', 'visualization_msgs', 'diagnostic_msgs'}
MAY_IMPORT_ROS = ('dae_ros/ros/', 'nodes/', 'launch/', 'tests/', 'benchmarks/', 'examples/', 'scripts/')
BY_NAME = ('__import__', 'import_module', 'importlib.import_module')
RUNS_WHAT_IT_READS = {'pickle', 'cPickle', '_pickle', 'cloudpickle', 'dill', 'joblib', 'marshal', 'shelve'}


def python_files():
    for folder, folders, files in os.walk(REPOSITORY):
        folders[:] = sorted(name for name in folders if not name.startswith('.')
                            and not (name in NOT_OURS and Path(folder) == REPOSITORY))
        yield from (Path(folder, name) for name in sorted(files) if name.endswith('.py'))


PATHS = [path.relative_to(REPOSITORY).as_posix() for path in python_files()]
TREES = {path: ast.parse((REPOSITORY / path).read_text(encoding='utf-8'), path) for path in PATHS}
OURS = pytest.mark.parametrize('path', PATHS)
LIBRARY = [path for path in PATHS if path.startswith('dae_ros/')]


def dotted(node):
    """`a.b.c` of a chain of attributes, or '' for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        parent = dotted(node.value)
        return parent and f'{parent}.{node.attr}'
    return ''


def imports(tree):
    """Every module imported anywhere in the file, by its full name, and every name imported from one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module
            yield from (f'{node.module}.{name.name}' for name in node.names)
        elif isinstance(node, ast.Call) and dotted(node.func) in BY_NAME:
            yield from (argument.value for argument in node.args[:1] if isinstance(argument, ast.Constant))


def packages(tree):
    return {name.split('.')[0] for name in imports(tree)}


def offences(tree):
    """What no file may do: load what runs code, or catch everything without saying so."""
    for name in imports(tree):
        if name.split('.')[0] in RUNS_WHAT_IT_READS or name == 'torch.load':
            yield name
    for node in ast.walk(tree):
        if isinstance(node, (ast.Name, ast.Attribute)) and dotted(node) in ('torch.load', 'torch.save'):
            yield dotted(node)
        elif isinstance(node, ast.keyword) and node.arg == 'allow_pickle':
            if not isinstance(node.value, ast.Constant) or node.value.value is not False:
                yield 'allow_pickle'
        elif isinstance(node, ast.ExceptHandler) and node.type is None:
            yield 'bare except'


def test_the_files_are_found():
    assert {'dae_ros/config.py', 'dae_ros/ros/convert.py', 'nodes/agent.py', 'tests/test_imports.py'} <= set(PATHS)
    assert not any(path.startswith(('build/', 'install/', '.')) for path in PATHS)


@pytest.mark.parametrize('source, found', [
    ('import pickle', ['pickle']), ('def f():\n    from pickle import loads', ['pickle', 'pickle.loads']),
    ('import os, cloudpickle as c', ['cloudpickle']), ('__import__("dill")', ['dill']),
    ('import importlib\nimportlib.import_module("marshal")', ['marshal']),
    ('import torch\ntorch.load(path)', ['torch.load']), ('from torch import load', ['torch.load']),
    ('np.load(path, allow_pickle=True)', ['allow_pickle']),
    ('np.load(path, allow_pickle=flag)', ['allow_pickle']), ('np.load(path, allow_pickle=False)', []),
    ('try:\n    f()\nexcept:\n    pass', ['bare except']), ('try:\n    f()\nexcept ValueError:\n    pass', []),
    ('"""No pickle."""\nimport torch\ntorch.loads = 1', [])])
def test_an_offence_is_found_wherever_it_stands(source, found):
    assert list(offences(ast.parse(source))) == found


@OURS
def test_no_file_loads_what_runs_code_or_catches_everything(path):
    assert list(offences(TREES[path])) == []


@pytest.mark.parametrize('path', [path for path in PATHS if not path.startswith(MAY_IMPORT_ROS)])
def test_outside_the_folders_that_wire_it_nothing_imports_ros(path):
    assert not packages(TREES[path]) & ROS


def test_the_folders_that_wire_it_do_import_ros():
    """Else the test above would look for the wrong names."""
    for folder in ('dae_ros/ros/', 'nodes/'):
        found = set().union(*(packages(tree) for path, tree in TREES.items() if path.startswith(folder)))
        assert {'rclpy', 'dae_ros_msgs'} <= found


@pytest.mark.parametrize('path', LIBRARY)
def test_the_library_never_imports_the_nodes_or_the_tests(path):
    assert not packages(TREES[path]) & {'dae_ros_nodes', 'nodes', 'tests'}


@pytest.mark.parametrize('path', [path for path in LIBRARY if not path.startswith('dae_ros/ros/')])
def test_the_library_but_for_its_ros_folder_does_not_import_that_folder(path):
    assert not [name for name in imports(TREES[path]) if name == 'dae_ros.ros' or name.startswith('dae_ros.ros.')]


FORBIDDING = '''
import sys


class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {forbidden!r}:
            raise ImportError(f'{{name}} is not to be imported here')


sys.meta_path.insert(0, Forbidden())
'''
ACTING = '''
import numpy as np
from dae_ros.learning.policy import Policy, PolicyArchitecture

sizes = PolicyArchitecture(3, 2, 4, 1, 'relu')
policy = Policy(sizes, {name: np.zeros(shape, np.float32) for name, shape in sizes.shapes().items()})
policy.act(np.zeros((1, 3), np.float32), policy.initial_state(1), np.ones(1, bool))
'''


def run_forbidding(forbidden, code):
    return subprocess.run([sys.executable, '-c', FORBIDDING.format(forbidden=set(forbidden)) + code],
                          cwd=REPOSITORY, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize('module', ['dae_ros.learning.policy', 'dae_ros.rollout.lockstep', 'dae_ros.weights.codec'])
def test_what_a_robot_needs_to_act_is_imported_without_torch(module):
    done = run_forbidding({'torch'} | ROS, f'import {module}')
    assert done.returncode == 0, done.stderr


def test_a_robot_acts_without_torch():
    done = run_forbidding({'torch'} | ROS, ACTING)
    assert done.returncode == 0, done.stderr


def test_an_import_that_is_forbidden_fails():
    done = run_forbidding({'torch'}, 'import dae_ros.learning.networks')
    assert done.returncode != 0 and 'torch is not to be imported here' in done.stderr
