"""Packaging: one version, every file, three commands, and an error of one line if something is missing."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from configparser import ConfigParser
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest

from splatam_core.resources import config_dir
from splatam_ros import entry

ROOT = Path(__file__).resolve().parents[1]
NAME = 'splatam_ros'


def run_setup(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run setup.py as colcon does."""
    return subprocess.run(
        [sys.executable, 'setup.py', '--quiet', *arguments],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, check=False,
    )  # fmt: skip


def canonical(requirement: str) -> str:
    """The normalised distribution name that a requirement starts with."""
    return re.sub(r'[-_.]+', '-', re.match(r'[\w.-]+', requirement).group()).lower()


def files_below(folder: Path, pattern: str = '*') -> set[Path]:
    """Files by their path relative to the folder, without caches."""
    return {path.relative_to(folder) for path in folder.rglob(pattern) if path.is_file() and '__pycache__' not in path.parts}


def test_the_version_is_stated_once_and_is_the_installed_one() -> None:
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert metadata.version(NAME) == version, 'installed is another version: make setup'
    assert run_setup('--version').stdout.strip() == version
    for path in ('setup.py', 'setup.cfg', 'pyproject.toml', 'splatam_core/__init__.py'):
        assert version not in (ROOT / path).read_text(), f'{path} states the version again'


def test_the_newest_release_of_the_changelog_is_the_version() -> None:
    """A section ``Forthcoming`` may be above it."""
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    headings = re.findall(r'^(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(), re.MULTILINE)
    assert headings and headings[0] == version


def test_every_make_target_is_in_its_help() -> None:
    makefile = (ROOT / 'Makefile').read_text()
    targets = set(re.search(r'^\.PHONY: (.*)$', makefile, re.MULTILINE).group(1).split())
    shown = subprocess.run(['make', '--no-print-directory', 'help'], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert set(re.findall(r'^make (\S+)', shown, re.MULTILINE)) == targets - {'help'}


def test_the_commands_can_be_loaded() -> None:
    commands = {entry.name: entry for entry in metadata.distribution(NAME).entry_points if entry.group == 'console_scripts'}
    assert commands.keys() == {'splatam', 'splatam_node', 'splatam_bag_player'}
    assert all(callable(entry.load()) for entry in commands.values())


def test_every_dependency_is_bounded_below_and_pinned_for_tests() -> None:
    pinned = {canonical(line) for line in (ROOT / 'constraints.txt').read_text().splitlines() if '==' in line}
    required = [text for text in metadata.requires(NAME) if 'extra ==' not in text]
    assert required
    assert not [text for text in required if '>=' not in text]
    assert {canonical(text) for text in metadata.requires(NAME)} <= pinned


def test_every_extra_is_documented() -> None:
    """But ``lint``, which is for those who change the code."""
    page = (ROOT / 'docs' / 'install.md').read_text()
    extras = {*metadata.metadata(NAME).get_all('Provides-Extra')} - {'lint'}
    assert {extra for extra in extras if f'| `{extra}` |' not in page} == set()


def test_the_configuration_is_found() -> None:
    assert {'quick.yaml', 'splatam.yaml', 'splatam_s.yaml'} <= {path.name for path in config_dir().glob('presets/*')}


def test_every_python_file_is_packaged(tmp_path: Path) -> None:
    built = run_setup('build_py', '--build-lib', str(tmp_path))
    assert built.returncode == 0, built.stderr
    for package in (NAME, 'splatam_core', 'msg_adapters'):
        written = {path for path in files_below(ROOT / package, '*.py') if path.parts[0] != 'launch'}
        assert files_below(tmp_path / package, '*.py') == written
        assert files_below(tmp_path / package, '*.html') == files_below(ROOT / package, '*.html')


@pytest.fixture
def installed_data(tmp_path: Path) -> Path:
    """The files that are not code, below a prefix, as an installation puts them."""
    done = run_setup('install_data', '--install-dir', str(tmp_path))
    assert done.returncode == 0, done.stderr
    return tmp_path


def test_every_data_file_is_installed(installed_data: Path) -> None:
    share = installed_data / 'share'
    assert (share / f'ament_index/resource_index/packages/{NAME}').is_file()
    assert (share / NAME / 'package.xml').is_file()
    assert files_below(share / NAME / 'config') == files_below(ROOT / 'config')
    assert files_below(share / NAME / 'launch') == files_below(ROOT / NAME / 'launch', '*.launch.py')


@pytest.mark.parametrize('libraries', ['lib/python3.12/site-packages', 'local/lib/python3.12/dist-packages', '.'])
def test_the_configuration_is_found_where_it_is_installed(installed_data: Path, libraries: str) -> None:
    """pip's prefix, Debian's, and ``pip install --target``; the working directory must not matter."""
    package = installed_data / libraries / 'splatam_core'
    package.mkdir(parents=True)
    for name in ('__init__.py', 'errors.py', 'resources.py'):
        (package / name).write_bytes((ROOT / 'splatam_core' / name).read_bytes())
    found = subprocess.run(
        [sys.executable, '-c', 'from splatam_core.resources import config_dir; print(config_dir())'],
        cwd=package.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.stdout.strip() == str(installed_data / 'share' / NAME / 'config'), found.stderr


def test_a_missing_compiler_is_one_line(tmp_path: Path) -> None:
    built = run_setup('build_ext', '--build-lib', str(tmp_path), '--build-temp', str(tmp_path), CXX='no-such-compiler')
    assert built.returncode == 1
    assert built.stderr.splitlines() == [
        "splatam_ros: no C++ compiler (looked for 'no-such-compiler'): apt install g++ python3-dev, or set CXX; with a GPU, "
        'SPLATAM_WITHOUT_NATIVE=1 builds without'
    ]


def test_an_installation_for_the_gpu_needs_no_compiler(tmp_path: Path) -> None:
    """Everything but the native module is there, and only what needs that module says so."""
    built = run_setup(
        'build', '--build-base', str(tmp_path / 'build'), '--build-lib', str(tmp_path / 'lib'),
        CXX='no-such-compiler', CC='no-such-compiler', SPLATAM_WITHOUT_NATIVE='1',
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert not list(tmp_path.rglob('*.so'))
    code = (
        'import sys; sys.meta_path = [finder for finder in sys.meta_path if "editable" not in str(finder.__module__)]\n'
        'import splatam_core.slam, splatam_core.errors as errors; from splatam_core.rasterizer import make_rasterizer\n'
        'print(splatam_core.__file__); make_rasterizer("reference")\n'
        'try: make_rasterizer("cpu", 1)\n'
        'except errors.RasterizerError as error: print(error)'
    )
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path / 'lib')}
    done = subprocess.run([sys.executable, '-c', code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    where, refused = done.stdout.splitlines()
    assert where.startswith(str(tmp_path)) and 'native module' in refused, done.stderr


@pytest.mark.parametrize('program', ['node', 'player'])
def test_without_ros_one_line_says_what_to_install(program: str) -> None:
    """In a Python that finds no rclpy: the import system is told that there is none."""
    code = f"import sys; sys.modules['rclpy'] = None; from splatam_ros import entry; sys.exit(entry.{program}())"
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and 'pip install' in done.stderr


@pytest.mark.parametrize('program', ['node', 'player'])
def test_ctrl_c_while_it_loads_is_no_traceback(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(module: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, 'import_module', interrupted)
    assert getattr(entry, program)() == 128 + signal.SIGINT


def test_scripts_start_with_the_python_of_the_environment() -> None:
    """colcon of apt builds with the system's Python, which does not see an active virtual environment."""
    settings = ConfigParser()
    settings.read(ROOT / 'setup.cfg')
    assert settings['build_scripts']['executable'] == '/usr/bin/env python3'
