"""The rules by which the pages' code blocks are tried: what they find, and that a block that is wrong fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs import blocks
from tests.docs.run import BlockError, PageRun
from tests.docs.shell import commands, differs

PAGE = """\
% not run: needs a moon
% for people: not a mark
```sh
fly --to moon
```

A paragraph ends what a comment says.

```python
x = 1
```

1. item

   <!-- file: a.toml -->
   ```toml
   title = "x"
   ```

:::{note}
```{code-block} python
:caption: c

y = 2
```
:::

```{cli-help} fly
```
"""


def test_blocks_are_found_with_their_lines_and_marks() -> None:
    found = list(blocks.find(PAGE, "p.md"))
    assert [(block.line, block.language, block.text) for block in found] == [
        (3, "sh", "fly --to moon\n"),
        (9, "python", "x = 1\n"),
        (16, "toml", 'title = "x"\n'),
        (21, "python", "y = 2\n"),
    ]
    assert [block.marks for block in found] == [{"not run": "needs a moon"}, {}, {"file": "a.toml"}, {}]


def test_every_page_has_its_blocks_and_the_index_is_one() -> None:
    assert {"README.md", "docs/index.md", "docs/howto/scenarios.md"} <= set(blocks.pages())
    assert len(blocks.of_page("docs/howto/scenarios.md")) >= 5


def test_a_shell_block_is_commands_with_what_they_print() -> None:
    text = (
        "$ A=1 mavsitl fly 'my file.toml' \\\n    --seed 7   # remark\nlogs: runs/1\n"
        "$ sleep 2; .venv/bin/mavsitl chaos && x | y\n"
    )
    found = commands(text, "console")
    assert [command.words for command in found] == [
        ["mavsitl", "fly", "my file.toml", "--seed", "7"], ["sleep", "2"], [".venv/bin/mavsitl", "chaos"], ["x"], ["y"],
    ]  # fmt: skip
    assert found[0].environment == ["A=1"]
    assert found[0].shown == "logs: runs/1\n"
    assert [command.program for command in found] == ["mavsitl", "sleep", "mavsitl", "x", "y"]
    assert commands("python -m mavsitl fly a", "sh")[0].arguments == ["fly", "a"]


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("x is 1.5e-3 m", "so: x is  27 m\nand", True),
        ("first\n...\nlast", "first\nsecond\nlast", True),
        ("┏━━┓\n┃ 1 ┃", "│ 25 │", True),
        ("vehicle 1 found", "vehicle 1 lost", False),
        ("first\n...\nlast", "last\nfirst", False),
        ("MC_ROLL_P2", "MC_ROLL_P3", False),
    ],
)
def test_output_is_compared_but_for_numbers_and_frames(shown: str, printed: str, same: bool) -> None:
    assert (differs(shown, printed) == "") is same


WRONG = [
    ("python", "1 / 0", "division"),
    ("python", "def test_it():\n    assert 1 == 2\n", "assert 1 == 2"),
    ("python", "if __name__ == '__main__':\n    raise SystemExit(3)\n", "exit code 3"),
    ("toml", 'title = "x"\n[wind]\n', "no scenario"),
    ("toml", "[controller]\nlaw = 'pdi'\n", "pdi"),
    ("toml", "a = ", "no TOML"),
    ("sh", "mavsitl fly --sped 2", "--sped"),
    ("sh", "mavsitl fly no-such-scenario", "no-such-scenario"),
    ("sh", "mavsitl vehicle --set controller.law=pdi", "pdi"),
    ("sh", "mavsitl scenarios\nqgroundcontrol", "qgroundcontrol: not run here"),
    ("sh", "python -m tests.nothing", "no module"),
    ("console", "$ mavsitl scenarios\nnothing of the kind", "prints something else"),
    ("json", "{", "no json"),
    ("rust", "fn main() {}", "nobody can run"),
    ("", "x", "nobody can run"),
]


@pytest.mark.parametrize(("language", "text", "said"), WRONG)
def test_a_block_that_is_wrong_fails_with_its_place(language: str, text: str, said: str, tmp_path: Path) -> None:
    block = blocks.Block("docs/p.md", 7, language, text)
    with pytest.raises((BlockError, ZeroDivisionError), match=r"docs/p\.md:[78]|division") as caught:
        PageRun(tmp_path).run(block)
    assert said in str(caught.value)


def test_a_block_that_is_not_run_needs_a_reason_and_is_parsed(tmp_path: Path) -> None:
    run = PageRun(tmp_path)
    run.run(blocks.Block("p.md", 1, "sh", "qgroundcontrol\nmavsitl vehicle", {"not run": "needs it"}))
    with pytest.raises(BlockError, match="without a reason"):
        run.run(blocks.Block("p.md", 1, "sh", "qgroundcontrol", {"not run": ""}))
    with pytest.raises(BlockError, match="--sped"):
        run.run(blocks.Block("p.md", 1, "sh", "mavsitl vehicle --sped 2", {"not run": "needs it"}))


def test_blocks_of_a_page_see_one_another(tmp_path: Path) -> None:
    run = PageRun(tmp_path)
    run.run(blocks.Block("p.md", 1, "python", "a = 2"))
    run.run(blocks.Block("p.md", 4, "text", "3\n", {"file": "sub/n.txt"}))
    run.run(
        blocks.Block("p.md", 7, "python", "from pathlib import Path\nprint(a + int(Path('sub/n.txt').read_text()))")
    )
    run.run(blocks.Block("p.md", 9, "text", "5\n", {"output": ""}))
    with pytest.raises(BlockError, match="something else"):
        run.run(blocks.Block("p.md", 9, "text", "five\n", {"output": ""}))


def test_the_exit_code_that_is_said_is_the_one_that_is_right(tmp_path: Path) -> None:
    run = PageRun(tmp_path)
    lost = "mavsitl report nothing-here"
    run.run(blocks.Block("p.md", 1, "sh", lost, {"exit": "2"}))
    with pytest.raises(BlockError, match="exit code 2"):
        run.run(blocks.Block("p.md", 1, "sh", lost))
