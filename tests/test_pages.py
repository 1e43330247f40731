"""README.md and docs/: links lead somewhere, commands take the options shown, and what is counted is so many."""

import re
from pathlib import Path

import pytest
import typer

from nfc_gym import wrappers
from nfc_gym.cli import app
from nfc_gym.envs.registry import ROBOTS
from nfc_gym.physics.effects import FAMILIES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(ROOT.glob("docs/*.md"))
README = (ROOT / "README.md").read_text(encoding="utf-8")
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What a heading is called in a link: lower case, hyphens for spaces, no other punctuation."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    for link in re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text):
        if link.startswith("http"):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    missing = [page.name for page in PAGES if page.name != "README.md" and f"{page.name})" not in index]
    assert missing == []


def shown() -> list[tuple[str, str]]:
    """(page, line) of every `nfc-gym ...` line of a code block."""
    blocks = [(page.name, block) for page in PAGES for block in FENCED.findall(page.read_text(encoding="utf-8"))]
    return [(name, line) for name, block in blocks for line in block.splitlines() if line.startswith("nfc-gym ")]


@pytest.mark.parametrize(("page", "line"), shown())
def test_commands_take_the_options_that_are_shown(page: str, line: str) -> None:
    words = line.split("#")[0].split()
    command = typer.main.get_group(app).commands.get(words[1])
    assert command is not None, f"{page}: {line}"
    taken = {name for parameter in command.params for name in parameter.opts + parameter.secondary_opts}
    assert {word.split("=")[0] for word in words if word.startswith("--")} <= taken | {"--help"}, f"{page}: {line}"


def test_what_the_readme_counts() -> None:
    families = sum(not family.generic for family in FAMILIES.values())
    assert f"{families} families of effects" in README
    assert {f"| {robot} |" in README for robot in ROBOTS} == {True}
    listed = re.findall(r"^\| `(\w+)\(env", README, re.MULTILINE)
    assert len(listed) == 9
    assert set(listed) == {name for name in wrappers.__all__ if f"Vector{name}" in wrappers.__all__}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_fit_a_screen(page: Path) -> None:
    rules = re.findall(r"^\|(?:\s*:?-+:?\s*\|)+$", FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    assert max((rule.count("|") - 1 for rule in rules), default=0) <= 8


def test_what_is_to_be_expected_is_what_was_measured() -> None:
    """The table that inference.md begins with says again what posteriors.md and README.md have."""
    said, measured = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("inference.md", "posteriors.md"))
    (flat,) = re.findall(r"^\| a minute of training on a GPU \|(.*)\|$", said, re.MULTILINE)
    (refined,) = re.findall(r"^\| refined for one window \|(.*)\|$", said, re.MULTILINE)
    robots = ("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter")
    for robot, gain, after in zip(robots, flat.split("|"), refined.split("|"), strict=True):
        assert re.search(rf"^\| {robot} Flat \| \d+ 000 \|.*\*\*{gain.strip()}\*\* \|$", measured, re.MULTILINE), robot
        assert re.search(rf"^\| {robot} \| [\d.]+ \| \*\*{after.strip()}\*\* \|", measured, re.MULTILINE), robot
        assert f" {gain.strip()} / " in README, robot
