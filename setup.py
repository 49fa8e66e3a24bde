"""Packaging: two ROS-free libraries, one node package, one native extension; the version is package.xml's."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import sys
import sysconfig
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

if sys.version_info < (3, 10):  # noqa: UP036
    sys.exit(f'splatam_ros: Python {sys.version.split()[0]} is too old: install Python 3.10, 3.11 or 3.12')

NAME = 'splatam_ros'
TOP_LEVEL = (NAME, 'splatam_core', 'msg_adapters')
CSRC = 'splatam_core/csrc'
PACKAGE_XML = ElementTree.parse('package.xml').getroot()
SYSTEM_PYBIND11 = Path('/usr/include/pybind11/pybind11.h')

HAS_TRITON_WHEEL = "sys_platform == 'linux' and (platform_machine == 'x86_64' or platform_machine == 'aarch64')"

# No -ffast-math: NaN must stay NaN. No -march: one build must run on every processor of the same architecture.
# -Wno-psabi: the warning is about passing wide vectors between functions, which this code does not do.
COMPILE_FLAGS = [
    '-std=c++17', '-O3', '-g0', '-fno-math-errno', '-fno-trapping-math', '-fvisibility=hidden', '-pthread',
    '-Wno-psabi',
]  # fmt: skip
WITHOUT_NATIVE = os.environ.get('SPLATAM_WITHOUT_NATIVE', '0') not in ('', '0')  # for machines with a GPU: needs no compiler
MORE_FLAGS = shlex.split(os.environ.get('SPLATAM_CXXFLAGS', ''))  # of the compiler and the linker; `make sanitize` sets them


def pybind11_include_dirs() -> list[str] | None:
    """Returns the folders to search for pybind11's headers, or None if pybind11 is not installed."""
    try:
        import pybind11
    except ImportError:
        return [] if SYSTEM_PYBIND11.is_file() else None
    return [pybind11.get_include()]


def missing_for_build() -> str | None:
    """Returns one line that says what to install before the extension can be built, or None if nothing is missing."""
    compiler = shlex.split(os.environ.get('CXX') or sysconfig.get_config_var('CXX') or 'g++')[0]
    if shutil.which(compiler) is None:
        return (
            f"no C++ compiler (looked for '{compiler}'): apt install g++ python3-dev, or set CXX; "
            'with a GPU, SPLATAM_WITHOUT_NATIVE=1 builds without'
        )
    if not Path(sysconfig.get_path('include'), 'Python.h').is_file():
        return f'no Python.h in {sysconfig.get_path("include")}: apt install g++ python3-dev'
    if pybind11_include_dirs() is None:
        return 'no pybind11 headers: apt install pybind11-dev, or pip install pybind11'
    return None


class BuildNative(build_ext):
    """Builds the native code and copies it into the source tree.

    The copy makes the checkout itself runnable: ``colcon test`` runs the tests there.
    """

    def run(self) -> None:
        """Build the extension; exit with one line if something is not installed."""
        if self.extensions and (missing := missing_for_build()):
            sys.exit(f'{NAME}: {missing}')
        super().run()
        if not self.inplace and not MORE_FLAGS and platform.machine() in self.plat_name:  # not when cross-compiling
            self.copy_extensions_to_source()


def native_extension() -> Extension:
    """Returns the C++ code of the ``cpu`` rasterizer and of alignment."""
    return Extension(
        'splatam_core._native',
        sources=sorted(glob(f'{CSRC}/*.cpp')),
        depends=sorted(glob(f'{CSRC}/*.[hi]*')),
        include_dirs=pybind11_include_dirs() or [],
        extra_compile_args=[*COMPILE_FLAGS, *MORE_FLAGS],
        extra_link_args=['-pthread', *MORE_FLAGS],
        language='c++',
    )


def shared_files() -> list[tuple[str, list[str]]]:
    """Returns the files that ROS expects below ``share`` and the configuration, by destination folder."""
    share = f'share/{NAME}'
    by_folder = {
        'share/ament_index/resource_index/packages': [f'resource/{NAME}'],
        share: ['package.xml', 'LICENSE'],
        f'{share}/launch': glob(f'{NAME}/launch/*.launch.py'),
    }
    for path in Path('config').rglob('*'):
        if path.is_file():
            by_folder.setdefault(f'{share}/{path.parent.as_posix()}', []).append(path.as_posix())
    return [(folder, sorted(files)) for folder, files in by_folder.items()]


setup(
    name=NAME,
    version=PACKAGE_XML.findtext('version'),
    description=PACKAGE_XML.findtext('description'),
    license=PACKAGE_XML.findtext('license'),
    maintainer=PACKAGE_XML.findtext('maintainer'),
    maintainer_email=PACKAGE_XML.find('maintainer').get('email'),
    packages=find_packages(include=[f'{package}{depth}' for package in TOP_LEVEL for depth in ('', '.*')]),
    ext_modules=[] if WITHOUT_NATIVE else [native_extension()],
    cmdclass={'build_ext': BuildNative},
    data_files=shared_files(),
    package_data={'splatam_core.evaluation.report': ['*.html']},
    python_requires='>=3.10',
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: C++',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Topic :: Scientific/Engineering :: Image Processing',
    ],
    install_requires=[
        'backports.zstd>=1.0',
        'jinja2>=3.1',
        'matplotlib>=3.6',
        'numpy>=1.26',
        'opencv-python-headless>=4.6',
        'pyyaml>=5.4',
        'rosbags>=0.11.7,<0.12',
        'torch>=2.2',
        'tqdm>=4.60',
    ],
    extras_require={
        'dask': ['distributed>=2024.1'],
        'exr': ['OpenEXR>=3.3'],
        'lint': [
            'clang-format>=19',
            'codespell>=2.4',
            'mypy>=1.11',
            'pre-commit>=3.5',
            'ruff>=0.8',
            'types-PyYAML>=6.0',
            'types-tqdm>=4.60',
        ],
        'mesh': ['open3d>=0.18'],
        'spz': ['gsply>=0.4'],
        'viewer': ['viser>=1.0'],
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': [
            'pytest>=7',
            'pytest-xdist>=3.5',
            'hypothesis>=6',
            'OpenEXR>=3.3',
            'playwright>=1.40',  # drives the browser of the tests; it downloads none
            'pytorch-msssim>=1.0',
            'distributed>=2024.1',
            'viser>=1.0',
            f'triton>=3.4; {HAS_TRITON_WHEEL}',  # interprets the GPU kernels on the CPU; CUDA builds of torch include it
        ],
    },
    entry_points={
        'console_scripts': [
            'splatam = splatam_core.cli:main',
            'splatam_node = splatam_ros.entry:node',
            'splatam_bag_player = splatam_ros.entry:player',
        ],
    },
    zip_safe=False,
)
