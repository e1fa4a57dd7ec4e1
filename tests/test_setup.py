"""Set-up: the sentences about what a machine lacks, the pinned lists, and that finished work is not done again."""
import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYTHONS = ('3.10.0', '3.11.7', '3.12.3', '3.13.1')
LISTS = ('python', 'ros', 'torch', 'uv')


class Machine:
    """A machine with nothing but what its folder of tools holds."""

    def __init__(self, folder):
        self.folder = folder
        self.env = {'PATH': str(folder), 'HOME': str(folder)}
        for tool in ('bash', 'dirname'):
            (folder / tool).symlink_to(shutil.which(tool))
        for tool in ('cc', 'c++', 'cmake'):
            self.script(tool, '')
        self.script('uname', '[ "$1" = -s ] && echo Linux || echo x86_64')
        self.python('python3')

    def script(self, name, text):
        path = self.folder / name
        path.write_text(f'#!{shutil.which("bash")}\n{text}\n')
        path.chmod(0o755)

    def python(self, name, change=''):
        """A Python that runs `change` before what it is given to run."""
        self.script(name, f'exec {sys._base_executable} -c \'import sys\n{change}\nexec(sys.stdin.read())\'')

    def ros(self, distro, *packages, python=None):
        """Source an installation of ROS that holds these packages."""
        prefix = self.folder / distro
        index = prefix / 'share/ament_index/resource_index/packages'
        index.mkdir(parents=True)
        for package in packages:
            (index / package).touch()
        if python:
            rclpy = prefix / f'lib/python{python}/site-packages/rclpy'
            rclpy.mkdir(parents=True)
            (rclpy / f'_rclpy_pybind11.cpython-{python.replace(".", "")}-x86_64-linux-gnu.so').touch()
        self.env.update(ROS_DISTRO=distro, AMENT_PREFIX_PATH=str(prefix))

    def check(self):
        return subprocess.run([shutil.which('bash'), ROOT / 'scripts/check.sh'], env=self.env, text=True,
                              stdin=subprocess.DEVNULL, capture_output=True, timeout=60)

    def complaint(self):
        """What set-up says it lacks: one line, and a failing status."""
        result = self.check()
        assert result.returncode == 1
        assert result.stdout == ''
        sentence, = result.stderr.splitlines()
        assert sentence.startswith('dae_ros: ') and sentence.endswith('.')
        return sentence


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path)


ROS_PACKAGES = ('rclpy', 'rosidl_default_generators', 'rmw_fastrtps_cpp', 'ament_cmake', 'std_srvs', 'diagnostic_msgs')


def test_a_machine_that_lacks_nothing_gets_its_python_named(machine):
    result = machine.check()
    assert result.returncode == 0, result.stderr
    assert Path(result.stdout.strip()).resolve() == Path(sys._base_executable).resolve()


@pytest.mark.parametrize('tool, remedy', [('cc', 'apt install build-essential'), ('c++', 'apt install build-essential'),
                                          ('cmake', 'apt install cmake'), ('python3', 'apt install python3 ')])
def test_a_missing_tool_is_named_with_its_remedy(machine, tool, remedy):
    (machine.folder / tool).unlink()
    assert remedy in machine.complaint()


def test_a_python_that_is_too_old_is_named_with_the_remedy(machine):
    machine.python('python3', 'sys.version_info = (3, 9, 18)')
    sentence = machine.complaint()
    assert 'python3 is 3.9' in sentence and 'PYTHON=' in sentence


def test_a_python_without_venv_is_named_with_the_remedy(machine):
    machine.python('python3', 'sys.modules["ensurepip"] = None')
    assert re.search(r'apt install python3\.1\d-venv', machine.complaint())


def test_a_python_without_headers_is_named_with_the_remedy(machine):
    machine.python('python3', 'import sysconfig; sysconfig.get_path = lambda name: "/nowhere"')
    assert re.search(r'apt install python3\.1\d-dev', machine.complaint())


def test_the_next_python_is_taken_where_the_first_will_not_do(machine):
    machine.script('python3', 'exit 127')
    machine.python('python3.12', 'sys.version_info = (3, 14, 0)')
    machine.python('python3.13')
    assert machine.check().returncode == 0


def test_a_python_that_is_asked_for_is_the_only_one_considered(machine):
    machine.env['PYTHON'] = 'python3.7'
    assert 'PYTHON=python3.7 is not a program' in machine.complaint()
    machine.python('python3.7', 'sys.version_info = (3, 7, 1)')
    assert 'python3.7 is 3.7' in machine.complaint()


def test_a_processor_without_wheels_needs_an_installed_ros(machine):
    machine.script('uname', '[ "$1" = -s ] && echo Linux || echo aarch64')
    assert 'Linux on aarch64' in machine.complaint()
    machine.ros('jazzy', *ROS_PACKAGES, python='%d.%d' % sys.version_info[:2])
    assert machine.check().returncode == 0


def test_another_ros_is_refused(machine):
    machine.ros('humble', *ROS_PACKAGES, python='3.10')
    assert 'humble' in machine.complaint()


def test_a_package_missing_from_the_sourced_ros_is_named(machine):
    machine.ros('jazzy', *ROS_PACKAGES[:-1], python='3.12')
    assert 'apt install ros-jazzy-diagnostic-msgs' in machine.complaint()


def test_the_sourced_ros_decides_which_python(machine):
    machine.ros('jazzy', *ROS_PACKAGES, python='3.9')
    assert 'PYTHON=/path/to/python3.9' in machine.complaint()


def read_list(name):
    return (ROOT / f'requirements/{name}.txt').read_text().splitlines()


@pytest.mark.parametrize('name', LISTS)
def test_every_line_of_a_list_pins_one_package_and_names_no_host(name):
    for line in read_list(name):
        assert re.fullmatch(r"[a-z0-9][a-z0-9.-]*==[a-z0-9.]+( ; python_full_version [<>=]+ '[0-9.]+')?", line), line


@pytest.mark.parametrize('python', PYTHONS)
def test_a_package_has_one_version_for_each_python(python):
    from packaging.requirements import Requirement
    pins = [Requirement(line) for name in LISTS for line in read_list(name)]
    names = [pin.name for pin in pins if pin.marker is None or pin.marker.evaluate({'python_full_version': python})]
    assert sorted(names) == sorted(set(names))


def test_what_is_asked_for_is_pinned():
    from packaging.requirements import Requirement
    pinned = {Requirement(line).name for name in LISTS for line in read_list(name)}
    for name in ('python', 'ros'):
        for line in (ROOT / f'requirements/{name}.in').read_text().splitlines():
            if line and not line.startswith('#'):
                assert Requirement(line).name in pinned
    assert set(setup_argument('install_requires')) <= pinned


def setup_argument(name):
    for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg == name:
            return ast.literal_eval(node.value)
    raise KeyError(name)


def test_the_packages_agree_on_their_version():
    manifests = [(ROOT / folder / 'package.xml').read_text() for folder in ('.', 'msg_schemas')]
    versions = {re.search('<version>(.*)</version>', manifest)[1] for manifest in manifests}
    assert versions == {setup_argument('version')}


def test_wheels_are_repaired_to_this_pythons_include_folders(tmp_path, monkeypatch):
    folder = tmp_path / 'share/some_msgs/cmake'
    folder.mkdir(parents=True)
    broken = folder / 'some_msgs__pyExport.cmake'
    broken.write_text('X "/far/cp311/include/python3.11;/far/numpy/_core/include;${_IMPORT_PREFIX}/include"')
    spec = importlib.util.spec_from_file_location('repair_wheels', ROOT / 'scripts/repair_wheels.py')
    repair_wheels = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(repair_wheels)
    monkeypatch.setattr(sys, 'prefix', str(tmp_path))
    for _ in range(2):
        repair_wheels.main()
        python, numpy, own = broken.read_text()[3:-1].split(';')
        assert (Path(python) / 'Python.h').exists() and (Path(numpy) / 'numpy').is_dir()
        assert own == '${_IMPORT_PREFIX}/include'


def own_environment():
    """This process's environment without what the `make` that may have started it hands down."""
    return {name: value for name, value in os.environ.items() if not name.startswith(('MAKE', 'MFLAGS', 'ARGS'))}


def run(command, **options):
    return subprocess.run(command, env=own_environment(), text=True, stdin=subprocess.DEVNULL, capture_output=True,
                          timeout=300, **options)


@pytest.mark.parametrize('shell', ['bash', 'zsh'])
def test_sourcing_the_environment_before_set_up_says_what_to_do(shell, tmp_path):
    if not shutil.which(shell):
        pytest.skip(f'{shell} is not installed')
    (tmp_path / 'scripts').mkdir()
    shutil.copy(ROOT / 'scripts/env.sh', tmp_path / 'scripts')
    result = run([shell, '-c', '. scripts/env.sh || echo "status $?"'], cwd=tmp_path)
    assert result.stdout == 'status 1\n' and f"{tmp_path} has no .venv: run 'make build'" in result.stderr


def require_set_up():
    if run([ROOT / 'scripts/setup.sh', '--done']).returncode:
        pytest.skip('needs `make build` first')


def test_a_second_build_does_nothing():
    require_set_up()
    start = time.monotonic()
    result = run(['make', 'build'], cwd=ROOT)
    assert (result.returncode, result.stdout, result.stderr) == (0, '', '')
    assert time.monotonic() - start < 5


def test_without_a_target_make_lists_them():
    listed = set(re.findall(r'^make (\w+)', run(['make'], cwd=ROOT).stdout, re.MULTILINE))
    assert {'help', 'build', 'demo', 'test', 'clean'} <= listed


@pytest.mark.slow  # colcon twice
@pytest.mark.parametrize('options', [[], ['--symlink-install']], ids=['copies', 'links'])
def test_a_workspace_builds_executables_for_the_python_of_the_build(tmp_path, options):
    require_set_up()
    source = tmp_path / 'src/dae_ros'
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns('.*', 'build', 'install', 'log', 'runs'))
    base_paths = ['--base-paths', 'src/dae_ros', 'src/dae_ros/msg_schemas']
    prepare = f'. {ROOT}/scripts/env.sh && cd {tmp_path} && '
    listed = run(['bash', '-c', prepare + ' '.join(['colcon list --names-only', *base_paths])])
    assert set(listed.stdout.split()) == {'dae_ros', 'dae_ros_msgs'}, listed.stderr
    # The messages, which take a minute, come from the set-up.
    select = ['--packages-select', 'dae_ros']
    built = run(['bash', '-c', prepare + ' '.join(['colcon build', *base_paths, *select, *options])])
    assert built.returncode == 0, built.stdout + built.stderr
    installed = tmp_path / 'install/dae_ros'
    for name in ('agent', 'bringup', 'parameter_server', 'trainer', 'world'):
        assert (installed / 'lib/dae_ros' / name).read_text().startswith(f'#!{ROOT}/.venv/bin/python')
    for path in [*ROOT.glob('config/*.yaml'), *ROOT.glob('config/*.xml'), *ROOT.glob('launch/*.py')]:
        assert (installed / 'share/dae_ros' / path.parent.name / path.name).exists()
    found = run(['bash', '-c', prepare + '. install/setup.bash && cd / && '
                 'python -c "import dae_ros.config, dae_ros_nodes; print(dae_ros_nodes.__file__)"'])
    assert str(tmp_path) in found.stdout, found.stderr
    if not options:
        assert list(installed.glob('lib/python3*/site-packages/dae_ros/learning/native/kernels.c'))
