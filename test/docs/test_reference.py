"""The reference is written from schemas and commands, and the site lists every page."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import yaml

from nics_drl_bridge.sim.world import World

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "site"))
import reference  # noqa: E402


def test_the_reference_is_what_the_schemas_and_commands_say():
    for name, text in reference.pages().items():
        written = (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8")
        assert written == text, (
            f"docs/reference/{name} is out of date; run `make reference`"
        )


def test_no_key_argument_or_parameter_of_the_reference_is_without_a_meaning():
    for name, text in reference.pages().items():
        rows = [
            line.split("|")[1:-1]
            for line in text.splitlines()
            if line.startswith("| `")
        ]
        bare = [row[0].strip() for row in rows if not row[-1].strip()]
        assert rows, name
        assert not bare, (
            f"docs/reference/{name}: say beside the field what it is: {bare}"
        )


def test_no_browser_takes_a_part_of_a_meaning_for_a_tag():
    assert "Default: &lt;robot>_model" in reference.pages()["commands.md"]
    for text in reference.pages().values():
        rows = [line for line in text.splitlines() if line.startswith("| `")]
        assert "<" not in re.sub("`[^`]*`", "", "".join(rows))


def test_a_key_has_its_type_default_range_and_the_comment_at_its_field():
    schema = World.model_json_schema()
    found = reference.rows(World, schema["properties"], schema["required"])
    rows = {row.split("|")[1].strip(): row for row in found}
    assert (
        "| number | `0.3` | ≥ 0 | free space around the footprint"
        in rows["`clearance`"]
    )
    assert "| text | required |" in rows["`name`"]


def test_every_page_of_the_reference_and_of_docs_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"[\w/]+\.md", text))
    written = {
        p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")
    }
    assert written <= listed, f"add to nav of mkdocs.yml: {sorted(written - listed)}"
    assert yaml.safe_load(text)["site_dir"] == "build/docs"
