"""``splatam bench``: runs presets on recordings with several seeds, and compares the runs."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.commands.compare import compare_runs
from splatam_core.commands.shared import (
    Command,
    add_set_argument,
    add_source_arguments,
    as_number,
    positive,
    say,
    source_of,
    source_words,
)
from splatam_core.errors import ConfigError, RunFolderError

if TYPE_CHECKING:
    from splatam_core.commands.job_runners import Job, Outcome
    from splatam_core.evaluation.variants import Variant
    from splatam_core.runs.record import Source


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser, nargs='+')
    parser.add_argument('--presets', required=True, metavar='A,B', help='shipped presets or .yaml files, separated by commas')
    parser.add_argument('--seeds', type=_seeds, default=(), metavar='0,1', help='run each preset with each of these seeds')
    add_set_argument(parser)
    parser.add_argument(
        '--out', type=Path, required=True, metavar='DIR', help='folder for the runs, one subfolder each; finished runs are kept'
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--jobs', type=positive, default=1, metavar='N', help='run N at a time (default: 1)')
    where.add_argument(
        '--dask', metavar='ADDRESS',
        help="run on the workers of a Dask cluster, such as tcp://host:8786 (needs pip install 'splatam_ros[dask]')",
    )  # fmt: skip


def _seeds(text: str) -> tuple[int, ...]:
    seeds = tuple(as_number(word, int) for word in text.split(',') if word.strip())
    if not seeds or len(set(seeds)) < len(seeds):
        raise argparse.ArgumentTypeError(f"'{text}': expected different whole numbers separated by commas, like 0,1,2")
    return seeds


def bench(args: argparse.Namespace) -> int:
    """Runs what is missing, each run in a process of its own, and compares all runs."""
    from splatam_core.evaluation.variants import is_finished

    planned = list(_plan(args))
    folders = [job.folder for job, _, _ in planned]
    if len(set(folders)) < len(folders):
        raise RunFolderError(f'two runs would have the same folder in {args.out}: choose other names of presets')
    missing = [job for job, variant, source in planned if not is_finished(variant, source, job.folder)]
    if len(missing) < len(planned):
        say(f'{len(planned) - len(missing)} of {len(planned)} runs are finished already')
    failed = {outcome.job.folder: outcome for outcome in _run(args, missing) if outcome.failure}
    finished = [folder for folder in folders if folder not in failed]
    if finished:
        print()
        compare_runs(finished, args.out / 'compare.png', args.out / 'compare.html')
    if failed:
        lines = (f'{outcome.job.name}: {outcome.failure}' for outcome in failed.values())
        raise RunFolderError(f'{len(failed)} of {len(planned)} runs failed; the same command tries them again: {"; ".join(lines)}')
    return 0


def _run(args: argparse.Namespace, jobs: Sequence[Job]) -> Iterator[Outcome]:
    from splatam_core.commands.job_runners import run_on_dask, run_one_by_one, run_side_by_side

    if not jobs:
        return
    if args.dask is not None:
        outcomes = run_on_dask(jobs, args.dask)
    else:
        outcomes = run_one_by_one(jobs) if args.jobs == 1 else run_side_by_side(jobs, args.jobs)
    if args.dask is not None or args.jobs > 1:
        say('runs beside others share the processor: their fps are no measurement')
    for number, outcome in enumerate(outcomes, 1):
        say(f'{outcome.job.name} {"failed: " + outcome.failure if outcome.failure else "is finished"} ({number} of {len(jobs)})')
        yield outcome


def _plan(args: argparse.Namespace) -> Iterator[tuple[Job, Variant, Source]]:
    """Yields each run with its settings and its recording.

    Raises:
        ConfigError: a preset or a setting is not allowed.
    """
    from splatam_core.commands.job_runners import Job

    variants = list(_variants(args))
    template = source_of(args, args.source[0])
    for source, name in zip(args.source, _names(args.source)):
        recording = replace(template, path=source_of(args, source).path)
        for variant in variants:
            run = f'{name}_{variant.name}'
            yield Job(run, ('run', *source_words(recording), *variant.words()), args.out / run), variant, recording


def _variants(args: argparse.Namespace) -> Iterator[Variant]:
    from splatam_core.config import parse_overrides
    from splatam_core.evaluation.variants import Variant

    presets = [preset.strip() for preset in args.presets.split(',') if preset.strip()]
    if len({Path(preset).stem for preset in presets}) < len(presets) or not presets:
        raise ConfigError(f"--presets {args.presets}: expected different presets separated by commas, like 'quick,tum'")
    overrides = parse_overrides(args.set)
    for preset in presets:
        for seed in args.seeds or (None,):
            name = Path(preset).stem + ('' if seed is None else f'_seed{seed}')
            variant = Variant(name, preset, overrides if seed is None else overrides | {'seed': seed})
            variant.config  # noqa: B018 -- raises before the first run, not hours later
            yield variant


def _names(sources: Sequence[str]) -> list[str]:
    """Returns a name for the run folders of each recording; equal names get a number."""
    plain = [re.sub(r'[^\w.-]+', '_', Path(source).resolve().name if '/' in source else source).strip('_.') for source in sources]
    plain = [re.sub(r'\.(db3|mcap|bag)$', '', name) or 'recording' for name in plain]
    return [name if plain.index(name) == index else f'{name}_{index + 1}' for index, name in enumerate(plain)]


COMMAND = Command('bench', 'run presets on recordings with several seeds, and compare the runs', _add_arguments, bench)
