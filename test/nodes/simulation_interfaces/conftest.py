from pathlib import Path

import pytest

CAMPAIGNS = Path(__file__).resolve().parents[2] / "campaigns"


@pytest.fixture(scope="module")
def client_of():
    """Makes clients of the standard, `client_of(domain_id)`; all are closed with the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(CAMPAIGNS))
        from parts.conformance import Client

        made = []

        def make(domain_id, prefix=""):
            made.append(Client(domain_id, prefix))
            return made[-1]

        yield make
        for each in made:
            each.close()
