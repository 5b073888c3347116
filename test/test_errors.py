import pickle

import pytest

from nics_drl_bridge import errors
from nics_drl_bridge.errors import BackendError, BridgeError, StaleDataError, suggest


def test_every_error_of_the_package_can_be_caught_as_a_bridge_error():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, Exception)]
    assert len(kinds) > 5
    assert all(issubclass(kind, BridgeError) for kind in kinds)


def test_stale_data_name_topic_age_and_limit():
    error = StaleDataError("scan", 1.25, 0.5)
    assert (error.topic, error.age_s) == ("scan", 1.25)
    assert isinstance(error, BackendError)
    assert "topic 'scan'" in str(error)
    assert "within 0.500 s" in str(error)
    assert "1.250 s old" in str(error)


@pytest.mark.parametrize(
    "error",
    [StaleDataError("scan", 1.0, 0.5), errors.ConfigError("a: wrong; mend it.")],
)
def test_errors_travel_between_processes(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_a_name_close_to_a_known_one_is_suggested_or_else_all_are_listed():
    assert suggest("ackerman", ["mecanum", "ackermann"]) == "did you mean 'ackermann'?"
    assert suggest("zzz", ["b", "a"]) == "valid are: 'a', 'b'"
