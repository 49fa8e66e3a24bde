"""Who may import whom: three packages, and the wings inside them, checked import by import; no import cycles."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('msg_adapters', 'splatam_core', 'splatam_ros')

BAG_READER = 'splatam_core.datasets.bag'  # a package
EXR_READER = 'splatam_core.datasets.files'
IMAGE_HEADERS = 'msg_adapters.image_headers'
TRITON = 'splatam_core.rasterizer.triton'  # a package
OPTIONAL = {
    'distributed': 'splatam_core.commands.job_runners',
    'gsply': 'splatam_core.maps.splat',
    'open3d': 'splatam_core.maps.export',
    'rich': 'splatam_core.maps.viewer.scene',
    'viser': 'splatam_core.maps.viewer.scene',
}
MESSAGES = {
    'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces', 'rosgraph_msgs',
    'sensor_msgs', 'std_msgs', 'std_srvs', 'tf2_msgs', 'visualization_msgs',
}  # fmt: skip
MAY_IMPORT = {
    'msg_adapters': {'cv2', 'msg_adapters', 'numpy'},
    'splatam_core': {'cv2', 'jinja2', 'matplotlib', 'numpy', 'splatam_core', 'torch', 'tqdm', 'yaml'},
    'splatam_ros': {
        'ament_index_python', 'launch', 'launch_ros', 'msg_adapters', 'numpy', 'rclpy', 'rosbags', 'splatam_core',
        'splatam_ros', 'tqdm', 'yaml', *MESSAGES,
    },
}  # fmt: skip
THREADING = {'_thread', 'asyncio', 'concurrent', 'multiprocessing', 'threading'}
MAY_THREAD = {'splatam_core.worker', 'splatam_ros.node.node', 'splatam_ros.player.read_ahead', 'splatam_ros.frames.buffer'}


FLOORS: tuple[tuple[str, ...], ...] = (
    ('splatam_core.errors', 'splatam_core.atomic_io', 'splatam_core.output'),
    ('splatam_core.resources', 'splatam_core.settings', 'splatam_core.retired_settings', 'splatam_core.text_files'),
    ('splatam_core.config',),
    ('splatam_core.geometry',),
    ('splatam_core.types',),
    ('splatam_core.device',),
    ('splatam_core.stopwatch', 'splatam_core.interruption', 'splatam_core.images'),
    ('splatam_core.datasets',),
    ('splatam_core._native',),
    ('splatam_core.rasterizer',),
    ('splatam_core.tracking', 'splatam_core.mapping'),
    ('splatam_core.graph',),
    ('splatam_core.state',),
    ('splatam_core.lifecycle',),
    ('splatam_core.correction',),
    ('splatam_core.slam',),
    ('splatam_core.worker', 'splatam_core.maps'),
    ('splatam_core.runs',),
    ('splatam_core.evaluation',),
    ('splatam_core.evaluation.report',),
    ('splatam_core.commands',),
    ('splatam_core.cli',),
    ('splatam_ros.process', 'splatam_ros.throttled_warnings', 'splatam_ros.interface', 'splatam_ros.cameras'),
    ('splatam_ros.subscription',),
    ('splatam_ros.frames', 'splatam_ros.player', 'splatam_ros.viewer'),
    ('splatam_ros.node',),
    ('splatam_ros.entry', 'splatam_ros.demo', 'splatam_ros.launch'),
)
"""Wings from the ground up. A wing imports only from floors below its own."""


@dataclass(frozen=True)
class Import:
    """One imported name.

    Attributes:
        name: absolute and dotted; of ``from a import b`` it is ``a.b``.
        line: where.
        deferred: whether it waits for a function to be called, or serves type checkers only.
    """

    name: str
    line: int
    deferred: bool

    @property
    def top(self) -> str:
        return self.name.partition('.')[0]


class ImportFinder(ast.NodeVisitor):
    """Collects every import of a module, also inside functions and as ``import_module('literal')``."""

    def __init__(self, module: str, is_package: bool) -> None:
        self.imports: list[Import] = []
        self._package = module.split('.') if is_package else module.split('.')[:-1]
        self._depth = 0

    def _add(self, name: str, node: ast.AST) -> None:
        self.imports.append(Import(name, node.lineno, self._depth > 0))

    def _visit_deferred(self, node: ast.AST) -> None:
        self._depth += 1
        self.generic_visit(node)
        self._depth -= 1

    visit_FunctionDef = visit_AsyncFunctionDef = visit_Lambda = _visit_deferred

    def visit_If(self, node: ast.If) -> None:
        only_for_types = ast.unparse(node.test).endswith('TYPE_CHECKING')
        (self._visit_deferred if only_for_types else self.generic_visit)(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(alias.name, node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        above = self._package[: len(self._package) - node.level + 1] if node.level else []
        module = '.'.join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            self._add(f'{module}.{alias.name}', node)

    def visit_Call(self, node: ast.Call) -> None:
        called = ast.unparse(node.func).rpartition('.')[2]
        if called in ('import_module', '__import__') and node.args and isinstance(node.args[0], ast.Constant):
            self._add(str(node.args[0].value), node)
        self.generic_visit(node)


def breach(module: str, imported: Import) -> str | None:
    """Why the module may not import this, or None."""
    package = module.partition('.')[0]
    if imported.top in THREADING or imported.name.startswith('torch.multiprocessing'):
        return None if module in MAY_THREAD else 'threads belong into worker.py, the node and the player'
    if imported.name.startswith(TRITON) and not imported.deferred and not module.startswith(TRITON):
        return 'triton is optional: import its rasterizer where it is needed'
    if imported.top in sys.stdlib_module_names or imported.top in MAY_IMPORT[package]:
        return None
    if package == 'msg_adapters' and imported.top in MESSAGES | {'rosbags'}:
        return None if imported.deferred else 'message classes are imported only where one is built'
    if is_inside(imported.name, IMAGE_HEADERS) and package == 'splatam_core':
        return None
    if imported.top in ('backports', 'msg_adapters', 'rosbags') and is_inside(module, BAG_READER):
        return None
    if imported.top == 'OpenEXR' and module == EXR_READER:
        return None if imported.deferred else 'OpenEXR is optional: import it where it is needed'
    if imported.top == 'triton' and module.startswith(TRITON):
        return None
    if OPTIONAL.get(imported.top) == module:
        return None if imported.deferred else f'{imported.top} is optional: import it where it is needed'
    return f'{package} may import only {", ".join(sorted(MAY_IMPORT[package]))} and the standard library'


def breaches(module: str, source: str, is_package: bool = False) -> Iterator[str]:
    """One line for each import of the source that the module may not have."""
    finder = ImportFinder(module, is_package)
    finder.visit(ast.parse(source))
    for imported in finder.imports:
        if why := breach(module, imported) or breach_of_floors(module, imported):
            yield f'{module}:{imported.line} imports {imported.name}: {why}'


def is_inside(module: str, package: str) -> bool:
    """Whether a module is a package, or in it."""
    return module == package or module.startswith(package + '.')


def wing_of(module: str) -> str | None:
    """The innermost wing that a module is in; None for the packages' own ``__init__``."""
    inside = [wing for floor in FLOORS for wing in floor if is_inside(module, wing)]
    return max(inside, key=len, default=None)


def floor_of(wing: str) -> int:
    """The number of a wing's floor, from the ground up."""
    return next(number for number, floor in enumerate(FLOORS) if wing in floor)


def breach_of_floors(module: str, imported: Import) -> str | None:
    """Why the module's wing may not import this, or None. What only type checkers see counts, too."""
    wing, other = wing_of(module), wing_of(imported.name)
    if wing is None or other is None or wing == other or floor_of(wing) > floor_of(other):
        return None
    return f'{wing} stands below or beside {other}'


def source_files() -> list[Path]:
    """Every Python file of the packages."""
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob('*.py'))


def module_name(path: Path) -> str:
    """The dotted name of a file's module."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def test_every_import_keeps_to_its_layer() -> None:
    found = [line for path in source_files() for line in breaches(module_name(path), path.read_text(), path.name == '__init__.py')]
    assert not found, '\n' + '\n'.join(found)


def test_every_module_is_in_a_wing() -> None:
    """Whoever adds a room says where it stands."""
    packages = [*PACKAGES, 'splatam_core.commands']
    modules = [module_name(path) for path in source_files() if not module_name(path).startswith('msg_adapters')]
    assert [module for module in modules if wing_of(module) is None and module not in packages] == []


def test_no_file_imports_itself_by_a_detour() -> None:
    """Imports when the modules are loaded; inside a function an import breaks a cycle, but hides it."""
    modules = {module_name(path): path for path in source_files()}
    graph = {name: {target for target in targets(path, modules) if target != name} for name, path in modules.items()}
    assert list(cycles(graph)) == []


def targets(path: Path, modules: Mapping[str, Path]) -> set[str]:
    """The modules of the packages that a file imports, inside functions too."""
    finder = ImportFinder(module_name(path), path.name == '__init__.py')
    finder.visit(ast.parse(path.read_text()))
    names = {imported.name for imported in finder.imports}
    return {name if name in modules else name.rpartition('.')[0] for name in names} & set(modules)


def cycles(graph: Mapping[str, set[str]]) -> Iterator[list[str]]:
    """Each cycle that a walk from every module closes first."""
    done: set[str] = set()
    for start in graph:
        stack = [(start, iter(sorted(graph[start])))] if start not in done else []
        on_path = [start] if stack else []
        while stack:
            name, following = stack[-1]
            target = next((target for target in following if target not in done), None)
            if target is None:
                done.add(name)
                on_path.pop()
                stack.pop()
            elif target in on_path:
                yield [*on_path[on_path.index(target) :], target]
            else:
                on_path.append(target)
                stack.append((target, iter(sorted(graph[target]))))


def test_a_cycle_is_seen() -> None:
    assert list(cycles({'a': {'b'}, 'b': {'c', 'd'}, 'c': {'a'}, 'd': set()})) == [['a', 'b', 'c', 'a']]
    assert list(cycles({'a': {'b', 'c'}, 'b': {'d'}, 'c': {'d'}, 'd': set()})) == []


@pytest.mark.parametrize(
    ('module', 'source'),
    [
        ('splatam_core.geometry.camera', 'from splatam_core.images.view import View'),
        ('splatam_core.mapping.mapper', 'from splatam_core.tracking.motion import MotionModel'),
        ('splatam_core.tracking.base', 'if TYPE_CHECKING:\n    from splatam_core.slam import Slam'),
        ('splatam_core.runs.record', 'def f():\n    from splatam_core.evaluation.score import score'),
        ('splatam_core.evaluation.score', 'from splatam_core.evaluation.report import html'),
        ('splatam_ros.frames.rep105', 'from splatam_ros.node.parameters import NodeOptions'),
        ('splatam_ros.player.player', 'from splatam_ros.frames import rep105'),
        ('splatam_core.slam', 'import rclpy'),
        ('splatam_core.slam', 'def f():\n    from rclpy.node import Node'),
        ('splatam_core.slam', 'from sensor_msgs.msg import Image'),
        ('splatam_core.slam', 'import msg_adapters.images'),
        ('splatam_core.datasets.tum', 'from msg_adapters import images'),
        ('splatam_core.datasets.tum', 'import rosbags.rosbag2'),
        ('splatam_core.datasets.bag.storage', 'import rclpy'),
        ('splatam_core.datasets.files', 'import OpenEXR'),
        ('splatam_core.datasets.record3d', 'def f():\n    import OpenEXR'),
        ('splatam_core.maps.splat', 'import gsply'),
        ('splatam_core.commands.job_runners', 'import distributed'),
        ('splatam_core.maps.viewer.panel', 'import viser'),
        ('splatam_core.slam', 'def f():\n    import open3d'),
        ('splatam_core.slam', 'import triton'),
        ('splatam_core.slam', 'from splatam_core.rasterizer.triton.rasterizer import TritonRasterizer'),
        ('splatam_core.slam', 'from splatam_ros import node'),
        ('splatam_core.slam', 'from ..splatam_ros import node'),
        ('splatam_core.slam', "import importlib\nimportlib.import_module('rclpy')"),
        ('splatam_core.slam', '__import__("rclpy")'),
        ('splatam_core.slam', 'import threading'),
        ('splatam_core.slam', 'from concurrent.futures import ThreadPoolExecutor'),
        ('splatam_core.slam', 'from torch import multiprocessing'),
        ('splatam_core.slam', 'try:\n    import rclpy\nexcept ImportError:\n    pass'),
        ('msg_adapters.images', 'import torch'),
        ('msg_adapters.images', 'from splatam_core.types import RgbdFrame'),
        ('msg_adapters.images', 'from sensor_msgs.msg import Image'),
        ('msg_adapters.synchronizer', 'def f():\n    import rclpy'),
        ('msg_adapters.synchronizer', 'if TYPE_CHECKING:\n    from splatam_core.types import RgbdFrame'),
        ('msg_adapters.synchronizer', 'import threading'),
        ('splatam_ros.node.outputs', 'import threading'),
        ('splatam_ros.node.outputs', 'import cv_bridge'),
        ('splatam_ros.node.outputs', 'from tf2_ros import TransformBroadcaster'),
    ],
)
def test_a_breach_is_seen(module: str, source: str) -> None:
    assert list(breaches(module, source))


@pytest.mark.parametrize(
    ('module', 'source'),
    [
        ('splatam_core.datasets.bag.storage', 'from msg_adapters import images\nfrom rosbags.rosbag2 import Reader'),
        ('splatam_core.slam', 'from .geometry import se3\nfrom .rasterizer.base import Render'),
        ('splatam_core.rasterizer', 'def f():\n    from splatam_core.rasterizer.triton.rasterizer import TritonRasterizer'),
        ('splatam_core.rasterizer.triton.lists', 'import triton\nfrom splatam_core.rasterizer.triton import kernels'),
        ('splatam_core.worker', 'import threading'),
        ('splatam_core.datasets.files', 'def f():\n    import OpenEXR'),
        ('splatam_core.maps.export', 'def f():\n    import open3d'),
        ('msg_adapters.factory', 'def f():\n    from sensor_msgs.msg import Image'),
        ('splatam_ros.node.node', 'import rclpy, threading\nfrom splatam_core.worker import SlamWorker'),
    ],
)
def test_what_is_allowed_stays_allowed(module: str, source: str) -> None:
    assert not list(breaches(module, source))


IMPORT_ALL = """
import importlib, pkgutil, sys
package = importlib.import_module(sys.argv[1])
for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
    importlib.import_module(module.name)
loaded = {name.partition('.')[0] for name in sys.modules}
print(*sorted(loaded & set(sys.argv[2:])))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ('package', 'never'),
    [
        ('msg_adapters', {'rclpy', 'rosbags', 'splatam_core', 'splatam_ros', 'torch', *MESSAGES}),
        ('splatam_core', {'rclpy', 'splatam_ros', *MESSAGES}),
    ],
)
def test_importing_everything_loads_nothing_from_above(package: str, never: set[str]) -> None:
    """The same rule at run time: what a library imports, and what that imports in turn."""
    loaded = subprocess.run(
        [sys.executable, '-c', IMPORT_ALL, package, *never], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert loaded.returncode == 0, loaded.stderr
    assert loaded.stdout.split() == []
