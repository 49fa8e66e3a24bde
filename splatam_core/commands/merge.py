"""``splatam merge``: joins the maps of two runs that show the same place."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.commands.shared import Command, add_device_argument, open_run, progress
from splatam_core.errors import MergeError

if TYPE_CHECKING:
    from splatam_core.maps.joining import Joint, SavedMap
    from splatam_core.runs.record import RunRecord


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('first', type=Path, metavar='A', help='run folder whose world and settings are kept')
    parser.add_argument('second', type=Path, metavar='B', help='run folder that is moved into the world of A')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for the merged run')
    add_device_argument(parser, "device to compute on (default: as A's settings say)")


def merge(args: argparse.Namespace) -> int:
    """Joins the maps of two runs."""
    from splatam_core.geometry import se3
    from splatam_core.maps.joining import find_joint, joined
    from splatam_core.rasterizer import rasterizer_for
    from splatam_core.runs.layout import check_is_free
    from splatam_core.runs.merging import Joined, write_merged
    from splatam_core.slam import Slam
    from splatam_core.tracking import make_tracker

    check_is_free(args.out)
    first, second = (open_run(path, args.device) for path in (args.first, args.second))
    first_map, second_map = _saved_map(first), _saved_map(second)
    _check_they_differ(first, second, first_map, second_map)
    config = first.config
    rasterizer, device = rasterizer_for(config)
    tracker = make_tracker(rasterizer, config.tracking, config.threads, device)
    there = [replace(one, gaussians=one.gaussians.to(device)) for one in (first_map, second_map)]
    joint = find_joint(there[0], second_map, tracker, config, progress('looking for A in B', 'keyframe'))
    T_first_second = joint.T_first_second
    if T_first_second is None:  # what the first run saw for a moment may be seen well by the second one
        back = find_joint(there[1], first_map, tracker, config, progress('looking for B in A', 'keyframe'))
        if back.T_first_second is not None:
            joint = replace(back, T_first_second=se3.inverse(back.T_first_second))
            T_first_second = joint.T_first_second
    if T_first_second is None:
        raise MergeError(_why_not_joined(joint, args))
    slam, both = Slam(config), joined(first_map, second_map, T_first_second)
    slam.load(both.gaussians, None, both.saved)
    slam.finish()
    write_merged(args.out, Joined(first, second, T_first_second), slam)
    print(_summary(joint, args, slam.num_gaussians, len(slam.keyframes)))
    return 0


def _saved_map(run: RunRecord) -> SavedMap:
    """Returns the map of a run with its keyframes.

    Raises:
        MergeError: there are none.
    """
    from splatam_core.maps.joining import SavedMap
    from splatam_core.runs.layout import MAP_KEYFRAMES
    from splatam_core.runs.map_keyframes import read_map_keyframes

    gaussians, path = run.read_map(), run.path / MAP_KEYFRAMES
    saved = read_map_keyframes(path) if path.is_file() else None
    if saved is None or not saved.keyframes:
        raise MergeError(
            f'{run.path} has no {MAP_KEYFRAMES}, so no place in it can be recognised: record it again with '
            'tracking.align.relocalisation.enabled=true, as the presets realtime and quick do'
        )
    if not run.config.tracking.relocalises:
        raise MergeError(f'{run.path}: its settings have tracking.align.relocalisation.enabled=false, so nothing can be recognised')
    return SavedMap(gaussians, saved)


def _check_they_differ(first: RunRecord, second: RunRecord, first_map: SavedMap, second_map: SavedMap) -> None:
    """Checks that two runs are not the same, and that their maps are of one kind.

    Raises:
        MergeError: they are the same, one holds the other, or one is isotropic and the other is not.
    """
    import torch

    means = first_map.gaussians.means, second_map.gaussians.means
    if first.path.resolve() == second.path.resolve() or (means[0].shape == means[1].shape and torch.equal(*means)):
        raise MergeError(f'{first.path} and {second.path} are the same run: there is nothing to merge')
    features = [_features(one) for one in (first_map, second_map)]
    for runs, is_held in (((first, second), features[0] <= features[1]), ((second, first), features[1] <= features[0])):
        if is_held and all(features):
            raise MergeError(f'{runs[1].path} has all keyframes of {runs[0].path} already: there is nothing to merge')
    kinds = ['isotropic' if one.gaussians.rotations is None else 'anisotropic' for one in (first_map, second_map)]
    if kinds[0] != kinds[1]:
        raise MergeError(f'{first.path} has {kinds[0]} Gaussians and {second.path} {kinds[1]} ones: maps of one kind can be merged')


def _features(one: SavedMap) -> set[bytes]:
    """Returns what the keyframes of a map are recognised by, one entry each. Merging keeps it bit for bit."""
    places, first, result = one.saved.places, 0, set()
    for count in places['counts'].tolist():
        result.add(places['descriptors'][first : first + count].tobytes() + places['points'][first : first + count].tobytes())
        first += count
    return result - {b''}  # without features


def _why_not_joined(joint: Joint, args: argparse.Namespace) -> str:
    looked = f'{joint.num_recognised} of {joint.num_looked_at} keyframes of {args.second} were recognised in {args.first}'
    if joint.num_recognised == 0:
        return f'{looked}: the runs must show the same place, from within some 30 degrees'
    if joint.num_seen == 0:
        return f'{looked}, and {joint.num_agreeing} of them agree: too few to be sure; a run that shows more of both places helps'
    return (
        f'{looked} and agree, but of {joint.num_seen} keyframes that would see both maps then only {joint.num_fitting} fit: '
        'these are different places that look alike'
    )


def _summary(joint: Joint, args: argparse.Namespace, num_gaussians: int, num_keyframes: int) -> str:
    import numpy as np

    from splatam_core.geometry import se3

    assert joint.T_first_second is not None
    turn = np.degrees(np.linalg.norm(se3.rotation_vector(joint.T_first_second[:3, :3])))
    where = ', '.join(f'{x:.2f}' for x in joint.T_first_second[:3, 3])
    return (
        f'{args.second} began at ({where}) m in {args.first}, turned by {turn:.0f} degrees: {joint.num_agreeing} of '
        f'{joint.num_recognised} keyframes that were recognised agree\n'
        f'{num_gaussians} Gaussians and {num_keyframes} keyframes are in {args.out}'
    )


COMMAND = Command('merge', 'join the maps of two runs that show the same place', _add_arguments, merge)
