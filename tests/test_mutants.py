"""The faults of ``mutants.py``, which is run by hand, still find their lines and their tests."""

from pathlib import Path

import pytest
from mutants import MUTANTS, Mutant

HERE = Path(__file__).parent


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant.name.replace(" ", "-") for mutant in MUTANTS])
def test_a_fault_finds_its_line(mutant: Mutant) -> None:
    text = (HERE.parent / "facerelight" / mutant.file).read_text()
    assert text.count(mutant.old) == 1, f"{mutant.file}: put the fault {mutant.name!r} into the line as it is now"
    assert mutant.new != mutant.old
    compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    assert (HERE / mutant.tests.split()[0]).is_file()


def test_the_table_holds_every_fault() -> None:
    lines = (HERE / "README.md").read_text().splitlines()
    for mutant in MUTANTS:
        assert f"| {mutant.name} | `{mutant.file}` | `{mutant.tests}` | killed |" in lines, mutant.name
