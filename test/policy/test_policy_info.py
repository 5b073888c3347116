from __future__ import annotations

import json
from pathlib import Path

from command_line import nics

from policy.policy_rig import SECTORS, export


def info(*words: object):
    return nics("policy", "info", *words, cwd=Path())


def test_nics_policy_info_tells_what_a_file_is_for_people_and_programs(tmp_path):
    path = tmp_path / "go.onnx"
    policy, _ = export(path)
    text = info(path)
    assert text.returncode == 0, text.stderr
    assert f"{SECTORS} sectors from -180 to 180 deg, 3 m" in text.stdout
    assert "all checks passed" in text.stdout
    (line,) = info(path, "--json").stdout.splitlines()
    facts = json.loads(line)
    assert facts["scan"]["sectors"] == SECTORS
    assert facts["graph_sha256"] == policy.contract.graph_sha256
    assert facts["provenance"] == {"command": "a test", "seed": 3}
