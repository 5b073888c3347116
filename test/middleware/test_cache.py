from __future__ import annotations

import pytest

from nics_drl_bridge.middleware.middleware import TopicCache


def test_only_newer_data_replace_the_newest():
    cache = TopicCache()
    assert cache.put("scan", 100, 101, "a")
    assert cache.put("scan", 200, 201, "b")
    assert not cache.put("scan", 150, 202, "late")
    assert not cache.put("scan", 200, 203, "copy")
    held = cache.newest["scan"]
    assert (held.value, held.stamp_ns, held.arrival_ns, held.sequence) == ("b", 200, 201, 1)


def test_refusals_are_counted_by_topic_and_reason():
    cache = TopicCache()
    for stamp in (5, 5, 5, 3, 9):
        cache.put("scan", stamp, 0, None)
    cache.put("odom", 4, 0, None)
    cache.put("odom", 1, 0, None)
    assert cache.rejected == {
        "scan: duplicate": 2,
        "scan: out of order": 1,
        "odom: out of order": 1,
    }


def test_topics_do_not_disturb_each_other():
    cache = TopicCache()
    cache.put("scan", 1000, 0, "s")
    assert cache.put("odom", 10, 0, "o")
    assert cache.newest["odom"].sequence == 0


def test_age_counts_from_the_stamp_and_is_infinite_without_data():
    cache = TopicCache()
    assert cache.age_s("scan", 5) == float("inf")
    cache.put("scan", 1_000_000_000, 1_900_000_000, None)
    assert cache.age_s("scan", 2_500_000_000) == pytest.approx(1.5)


def test_two_caches_share_nothing():
    one, other = TopicCache(), TopicCache()
    one.put("scan", 1, 1, None)
    one.reject("reason")
    assert not other.newest
    assert not other.rejected
