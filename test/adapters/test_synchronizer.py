"""Pairing with late, lost, duplicate and unordered messages, and with time that jumps back."""

from __future__ import annotations

import random
from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_adapters.interval import PairInterval
from msg_adapters.pairing import Key, first_pair
from msg_adapters.synchronizer import RgbdSynchronizer

MS = 1_000_000
PERIOD = 33 * MS
SECOND = 1000 * MS


@dataclass(frozen=True)
class Message:
    """An opaque message that holds its stream and stamp."""

    stream: str
    stamp_ns: int
    serial: int = 0


class Feed:
    """Adds messages to a synchronizer and collects the sets."""

    def __init__(self, mode='exact', *, with_info=True, **settings):
        self.synchronizer = RgbdSynchronizer(mode, **settings)
        self.sets = []
        self.serial = 0
        if with_info:
            self.add('info', 0)

    def add(self, stream, *stamps_ns):
        for stamp_ns in stamps_ns:
            self.serial += 1
            message = Message(stream, stamp_ns, self.serial)
            self.sets += getattr(self.synchronizer, f'add_{stream}')(stamp_ns, message)
        return self

    def flush(self):
        self.sets += self.synchronizer.flush()
        return self

    @property
    def stamps(self):
        return [s.stamp_ns for s in self.sets]

    @property
    def pairs(self):
        return [(s.color.stamp_ns, s.depth.stamp_ns) for s in self.sets]

    @property
    def statistics(self):
        return self.synchronizer.statistics


# One thing at a time, exact mode


def test_equal_stamps_pair_at_once_whichever_comes_first():
    feed = Feed().add('color', 10).add('depth', 10)
    assert feed.pairs == [(10, 10)]
    feed.add('depth', 20).add('color', 20)
    assert feed.pairs == [(10, 10), (20, 20)]
    assert [s.gap_ns for s in feed.sets] == [0, 0]


def test_a_set_holds_the_very_messages():
    synchronizer = RgbdSynchronizer()
    color, depth, info = object(), object(), object()
    synchronizer.add_info(1, info)
    synchronizer.add_depth(5, depth)
    (found,) = synchronizer.add_color(5, color)
    assert found.color is color and found.depth is depth and found.info is info


def test_late_depth_pairs_while_its_colour_waits():
    feed = Feed().add('color', 1, 2, 3).add('depth', 1).add('color', 4).add('depth', 2, 3, 4)
    assert feed.stamps == [1, 2, 3, 4]


def test_a_lost_message_costs_one_set_and_is_counted():
    feed = Feed().add('color', 1, 2, 3).add('depth', 1, 3).add('color', 5).add('depth', 4, 5)
    assert feed.stamps == [1, 3, 5]
    assert (feed.statistics.unpaired_color, feed.statistics.unpaired_depth) == (1, 1)


@pytest.mark.parametrize('stream', ['color', 'depth'])
def test_duplicates_are_dropped_waiting_or_paired(stream):
    other = 'depth' if stream == 'color' else 'color'
    feed = Feed().add(stream, 1, 1).add(other, 1).add(stream, 1)
    assert feed.stamps == [1]
    assert feed.statistics.duplicates == 2
    assert feed.sets[0].color.serial in (2, 4) and feed.sets[0].depth.serial in (2, 4)  # the first of them


def test_out_of_order_messages_pair_while_their_partner_waits():
    feed = Feed().add('color', 1, 2).add('depth', 3, 2).add('color', 3)
    assert feed.stamps == [2, 3]
    feed = Feed().add('color', 1).add('depth', 2, 1).add('color', 2)
    assert feed.stamps == [1, 2]


def test_a_message_older_than_the_last_set_is_late():
    feed = Feed().add('color', 1, 2).add('depth', 2, 1).add('color', 1)
    assert feed.stamps == [2]
    assert feed.statistics.late == 2
    assert feed.statistics.resets == 0


def test_unequal_stamps_do_not_pair_in_exact_mode_and_the_gap_is_told():
    feed = Feed(max_interval_ns=20).add('color', 100, 200).add('depth', 101, 201).flush()
    assert feed.sets == []
    assert feed.statistics.newest_gap_ns == 1
    assert feed.statistics.gap_ns is None


def test_a_full_queue_drops_the_oldest():
    feed = Feed(queue_size=3).add('color', 1, 2, 3, 4, 5)
    assert (feed.statistics.waiting_color, feed.statistics.unpaired_color) == (3, 2)
    feed.add('depth', 2, 3, 5)
    assert feed.stamps == [3, 5]


@pytest.mark.parametrize('settings', [{'mode': 'fuzzy'}, {'max_interval_ns': -1}, {'queue_size': 0}, {'jump_ns': -1}])
def test_settings_out_of_range_are_errors(settings):
    with pytest.raises(ValueError, match=f'{next(iter(settings.values()))}'):
        RgbdSynchronizer(**settings)


# CameraInfo


def test_pairs_wait_for_the_first_info():
    feed = Feed(with_info=False).add('color', 1, 2).add('depth', 1, 2)
    assert feed.sets == [] and feed.statistics.waiting_pairs == 2
    feed.add('info', 7)
    assert feed.stamps == [1, 2]
    assert all(s.info.stamp_ns == 7 for s in feed.sets)


def test_no_more_pairs_than_the_queue_holds_wait_for_the_info():
    stamps = list(range(1, 8))
    feed = Feed(with_info=False, queue_size=3).add('color', *stamps[:3]).add('depth', *stamps[:3])
    for stamp in stamps[3:]:
        feed.add('color', stamp).add('depth', stamp)
    assert feed.statistics.waiting_pairs == 3
    feed.add('info', 0)
    assert feed.stamps == [5, 6, 7]
    assert feed.statistics.without_info == 4


def test_the_info_of_the_colours_stamp_is_preferred_else_the_newest_received():
    feed = Feed(with_info=False).add('info', 1, 2, 3).add('color', 2, 4).add('depth', 2, 4)
    assert [s.info.stamp_ns for s in feed.sets] == [2, 3]


def test_the_newest_info_is_the_last_received_whatever_its_stamp():
    feed = Feed(with_info=False).add('info', 1, 2, 1).add('color', 9).add('depth', 9)
    assert feed.sets[0].info.serial == 3


def test_an_info_sent_once_serves_later_loops():
    feed = Feed(with_info=False).add('info', 5 * SECOND)
    for _ in range(2):
        for stamp in (5 * SECOND, 9 * SECOND):
            feed.add('color', stamp).add('depth', stamp)
    assert len(feed.sets) == 4


def test_a_recording_without_info_gives_no_set_and_says_why():
    feed = Feed(with_info=False).add('color', 1, 2).add('depth', 1, 2).flush()
    assert feed.sets == []
    assert (feed.statistics.without_info, feed.statistics.waiting_pairs) == (2, 0)


# Approximate mode


def test_a_pair_waits_until_no_better_partner_can_come():
    feed = Feed('approximate', max_interval_ns=20).add('color', 100).add('depth', 110)
    assert feed.sets == []
    feed.add('color', 133)
    assert feed.pairs == [(100, 110)]


def test_a_better_partner_is_waited_for():
    feed = Feed('approximate', max_interval_ns=20).add('depth', 90).add('color', 105).add('depth', 107)
    assert feed.pairs == []  # depth 107 fits better, but colour 108 could come and fit 107 still better
    feed.add('color', 140)
    assert feed.pairs == [(105, 107)]


def test_equal_stamps_need_no_waiting():
    feed = Feed('approximate', max_interval_ns=20).add('color', 100, 133).add('depth', 100)
    assert feed.pairs == [(100, 100)]
    feed = Feed('approximate', max_interval_ns=20).add('color', 90, 100).add('depth', 100)
    assert feed.pairs == [(100, 100)]


def test_partners_are_no_further_apart_than_the_interval():
    feed = Feed('approximate', max_interval_ns=20).add('color', 100, 200, 300).add('depth', 120, 221, 279).flush()
    assert feed.pairs == [(100, 120)]
    assert (feed.statistics.unpaired_color, feed.statistics.unpaired_depth) == (2, 2)


def test_streams_of_different_rates_pair_the_nearest():
    color = [33 * i for i in range(30)]
    depth = [66 * i + 30 for i in range(15)]
    feed = Feed('approximate', max_interval_ns=20)
    for stamp in sorted(color + depth):
        feed.add('color' if stamp in color else 'depth', stamp)
    feed.flush()
    assert feed.pairs == [(66 * i + 33, 66 * i + 30) for i in range(15)]


def test_flush_gives_out_what_waits_for_better():
    feed = Feed('approximate', max_interval_ns=20).add('color', 100).add('depth', 110).flush()
    assert feed.pairs == [(100, 110)]
    assert feed.statistics.gap_ns == 10


def test_nobody_is_left_over_where_everybody_can_have_a_partner():
    """With streams half a period apart, colour 40 fits depth 21 better than colour 0 does, but depth 58 is nearest to it."""
    assert Feed('approximate', max_interval_ns=25).add('color', 0, 40).add('depth', 21, 58).flush().pairs == [
        (0, 21),
        (40, 58),
    ]


def test_first_pair_skips_what_has_no_partner():
    keys = [Key(0, 5), Key(1, 3)]
    assert first_pair(keys, [Key(0, 9), Key(1, 3)], 2) == (Key(1, 3), Key(1, 3))
    assert first_pair(keys, [], 2) is None


def test_first_pair_compares_no_stamps_of_different_epochs():
    assert first_pair([Key(0, 5)], [Key(1, 5)], 2, is_final=True) is None


# Time jumps back


def loop_of_a_bag(frames, *, depth_delay=2, offset_ns=0, seed=0, loops=3, loss=0.1):
    """Colour and depth of a bag that loops, 10 % lost, depth two frames late (also over the loop's end)."""
    rng = random.Random(seed)
    color, depth, kept = [], [], []
    for loop in range(loops):
        for i in range(frames):
            slot = loop * frames + i
            stamp = 100 * SECOND + i * PERIOD
            has_color, has_depth = rng.random() >= loss, rng.random() >= loss
            color += [(slot, 'color', stamp)] * has_color
            depth += [(slot + depth_delay + 0.5, 'depth', stamp + offset_ns)] * has_depth
            kept += [(loop, stamp)] * (has_color and has_depth)
    return [(stream, stamp) for _, stream, stamp in sorted(color + depth)], kept


@pytest.mark.parametrize('depth_delay', [0, 2, -2])
@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('mode', ['exact', 'approximate'])
def test_every_loop_pairs_all_that_arrived(mode, seed, depth_delay):
    messages, kept = loop_of_a_bag(80, seed=seed, depth_delay=depth_delay)
    feed = Feed(mode, max_interval_ns=5 * MS)
    for stream, stamp in messages:
        feed.add(stream, stamp)
    feed.flush()
    assert [(s.resets, s.stamp_ns) for s in feed.sets] == kept
    assert feed.statistics.resets == 2


def test_every_loop_pairs_the_same_with_an_offset_between_the_streams():
    messages, kept = loop_of_a_bag(80, offset_ns=7 * MS)
    feed = Feed('approximate', max_interval_ns=10 * MS)
    for stream, stamp in messages:
        feed.add(stream, stamp)
    feed.flush()
    assert [(s.resets, s.stamp_ns) for s in feed.sets] == kept


def test_a_small_step_back_is_no_jump():
    feed = Feed(jump_ns=SECOND).add('color', 5 * SECOND, 4 * SECOND).add('depth', 4 * SECOND, 5 * SECOND)
    assert feed.stamps == [4 * SECOND, 5 * SECOND]
    assert feed.statistics.resets == 0


def test_a_jump_is_measured_from_the_newest_stamp_not_from_the_last():
    feed = Feed(jump_ns=SECOND).add('color', 50 * SECOND, 49_500 * MS, 48_900 * MS).add('depth', 48_900 * MS)
    assert (feed.stamps, feed.statistics.resets) == ([48_900 * MS], 1)


def test_after_a_jump_the_old_messages_are_dropped():
    feed = Feed().add('color', 90 * SECOND, 91 * SECOND).add('color', SECOND).add('depth', SECOND)
    assert feed.stamps == [SECOND]
    assert (feed.statistics.waiting_color, feed.statistics.unpaired_color, feed.statistics.resets) == (0, 2, 1)


def test_a_stream_that_pauses_over_the_jump_pairs_again():
    """Depth stops early in the first loop and returns late in the second, so its own stamps never jump back."""
    feed = Feed().add('color', 10 * SECOND).add('depth', 10 * SECOND)
    feed.add('color', *range(11 * SECOND, 100 * SECOND, SECOND))
    feed.add('color', *range(10 * SECOND, 50 * SECOND, SECOND))
    for second in range(50, 60):
        feed.add('color', second * SECOND).add('depth', second * SECOND)
    assert [(s.resets, s.stamp_ns // SECOND) for s in feed.sets] == [(0, 10), *((1, i) for i in range(50, 60))]


@pytest.mark.parametrize('wrong_ns', [0, 10**6 * SECOND])
@pytest.mark.parametrize('stream', ['color', 'depth'])
@pytest.mark.parametrize('mode', ['exact', 'approximate'])
def test_one_wrong_stamp_costs_few_sets(mode, stream, wrong_ns):
    feed = Feed(mode)
    for i in range(30):
        for name in ('color', 'depth'):
            is_wrong = i == 10 and name == stream
            feed.add(name, wrong_ns if is_wrong else 100 * SECOND + i * PERIOD)
    feed.flush()
    # The set of the wrong stamp, and the one whose partner waited when time seemed to begin anew.
    assert len(feed.sets) >= 28
    assert feed.stamps[-1] == 100 * SECOND + 29 * PERIOD


def test_a_driver_that_restarts_with_another_clock_pairs_again():
    feed = Feed().add('color', *range(100, 105)).add('depth', *range(100, 105))
    for i in range(3):
        feed.add('color', 10**6 * SECOND + i).add('depth', 10**6 * SECOND + i)
    for i in range(3):
        feed.add('depth', 500 * SECOND + i).add('color', 500 * SECOND + i)
    assert len(feed.sets) == 11
    assert feed.statistics.resets == 1


# Whatever comes

modes = st.sampled_from(['exact', 'approximate'])
streams = st.sampled_from(['color', 'depth', 'info'])
stamps = st.one_of(st.integers(0, 40), st.integers(0, 3).map(lambda i: 1000 * i))
arrivals = st.lists(st.tuples(streams, stamps), max_size=60)
any_settings = st.fixed_dictionaries(
    {
        'mode': modes,
        'max_interval_ns': st.integers(0, 12),
        'queue_size': st.integers(1, 6),
        'jump_ns': st.sampled_from([5, 20, 500]),
    }
)


@settings(max_examples=300, deadline=None)
@given(arrivals, any_settings)
def test_whatever_comes_sets_are_sound(messages, config):
    feed = Feed(with_info=False, **config)
    for stream, stamp in messages:
        feed.add(stream, stamp)
        statistics = feed.statistics
        waiting = statistics.waiting_color, statistics.waiting_depth, statistics.waiting_pairs
        assert max(waiting) <= config['queue_size']
        assert_every_message_is_accounted_for(statistics)
    feed.flush()
    assert_every_message_is_accounted_for(feed.statistics)
    assert feed.statistics.waiting_color == feed.statistics.waiting_depth == feed.statistics.waiting_pairs == 0
    assert_sound(feed, config)


def assert_every_message_is_accounted_for(s):
    paired = s.sets + s.without_info + s.waiting_pairs
    dropped = s.unpaired_color + s.unpaired_depth + s.duplicates + s.late
    assert s.received_color + s.received_depth == 2 * paired + dropped + s.waiting_color + s.waiting_depth


def assert_sound(feed, config):
    for name in ('color', 'depth'):
        serials = [getattr(s, name).serial for s in feed.sets]
        assert len(set(serials)) == len(serials)
        # Colour and depth both increase until time jumps back.
        order = [(s.resets, getattr(s, name).stamp_ns) for s in feed.sets]
        assert all(a < b for a, b in pairwise(order))
    interval = config['max_interval_ns'] if config['mode'] == 'approximate' else 0
    assert all(abs(c - d) <= interval for c, d in feed.pairs)
    assert all(s.color.stream == 'color' and s.depth.stream == 'depth' and s.info.stream == 'info' for s in feed.sets)


increasing = st.lists(st.integers(0, 120), max_size=25, unique=True).map(sorted)


@settings(max_examples=300, deadline=None)
@given(increasing, increasing, st.randoms(use_true_random=False), st.integers(0, 12), modes)
def test_pairs_do_not_depend_on_how_the_streams_interleave(color, depth, rng, interval, mode):
    in_order = sorted([(stamp, 'color') for stamp in color] + [(stamp, 'depth') for stamp in depth])
    expected = Feed(mode, max_interval_ns=interval, queue_size=25)
    for stamp, stream in in_order:
        expected.add(stream, stamp)
    feed = Feed(mode, max_interval_ns=interval, queue_size=25)
    turns = ['color'] * len(color) + ['depth'] * len(depth)
    rng.shuffle(turns)
    waiting = {'color': iter(color), 'depth': iter(depth)}
    for stream in turns:
        feed.add(stream, next(waiting[stream]))
    assert feed.flush().pairs == expected.flush().pairs
    if mode == 'exact':
        assert feed.stamps == sorted(set(color) & set(depth))


@settings(max_examples=200, deadline=None)
@given(increasing, increasing, st.integers(0, 12))
def test_no_two_neighbours_could_have_had_each_other(color, depth, interval):
    """No two unpaired messages between the same sets are within the interval of each other."""
    pairs = Feed('approximate', max_interval_ns=interval, queue_size=25).add('color', *color).add('depth', *depth)
    pairs = pairs.flush().pairs
    fences = [(-1, -1), *pairs, (1000, 1000)]
    for (c0, d0), (c1, d1) in pairwise(fences):
        left_color = [c for c in color if c0 < c < c1]
        left_depth = [d for d in depth if d0 < d < d1]
        assert not [(c, d) for c in left_color for d in left_depth if abs(c - d) <= interval]


# --- an interval that adapts to the rate ---


@pytest.mark.parametrize(('rate_hz', 'expected_ms'), [(60, 20), (30, 20), (15, 33), (10, 50), (2, 50)])
def test_the_interval_is_half_the_time_between_colour_images_but_20_to_50_ms(rate_hz, expected_ms):
    interval = PairInterval(None)
    assert interval.ns == 20 * MS
    for i in range(20):
        interval.add_color(i * SECOND // rate_hz)
    assert interval.ns // MS == expected_ms
    fixed = PairInterval(7)
    fixed.add_color(0)
    fixed.add_color(SECOND)
    assert fixed.ns == 7


def test_lost_images_and_jumps_back_do_not_change_the_interval():
    interval = PairInterval(None)
    for stamp in (0, 66, 132, 198, 398, 464, 530, 0, 66, 132):
        interval.add_color(stamp * MS)
    assert interval.ns == 33 * MS


def test_depth_that_is_late_by_more_than_20_ms_is_paired_at_15_hz():
    feed = Feed('approximate', max_interval_ns=None)
    for i in range(8):
        feed.add('color', i * 66 * MS).add('depth', i * 66 * MS + 30 * MS)
    feed.flush()
    assert [depth - color for color, depth in feed.pairs] == [30 * MS] * 8
    assert feed.statistics.max_interval_ns == 33 * MS
    none = Feed('approximate')
    for i in range(8):
        none.add('color', i * 66 * MS).add('depth', i * 66 * MS + 30 * MS)
    assert none.flush().pairs == []


def test_exact_mode_does_not_adapt():
    feed = Feed('exact', max_interval_ns=None)
    feed.add('color', 0, 66 * MS).add('depth', 1, 66 * MS).flush()
    assert feed.pairs == [(66 * MS, 66 * MS)]
