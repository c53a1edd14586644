"""The public names, their methods and signatures, beside a snapshot: a change is made on purpose, and seen in a diff.

``python tests/test_public_api.py`` writes the snapshot anew.
"""

import importlib
import inspect
from pathlib import Path

import facerelight

SNAPSHOT = Path(__file__).with_name("public_api.txt")


def described(name: str, thing: object) -> list[str]:
    """One line of a function; of a class, its own line and those of its public methods and properties."""
    if not inspect.isclass(thing):
        return [f"{name}{inspect.signature(thing)}"]  # type: ignore[arg-type]
    lines = [f"class {name}{inspect.signature(thing)}"]
    ours = [base for base in reversed(thing.__mro__) if base.__module__.startswith("facerelight")]
    members = {key: value for base in ours for key, value in vars(base).items() if key == "__call__" or key[0] != "_"}
    for key, value in sorted(members.items()):
        kind = "classmethod " if isinstance(value, classmethod) else ""
        value = inspect.getattr_static(thing, key)
        if isinstance(value, classmethod | staticmethod):
            value = value.__func__
        if inspect.isfunction(value):
            lines.append(f"    {kind}{key}{inspect.signature(value)}")
        elif isinstance(value, property):
            lines.append(f"    property {key}")
    return lines


def public_api() -> str:
    """Every public name, as in the snapshot."""
    return (
        "\n".join(line for name in facerelight.__all__ for line in described(name, getattr(facerelight, name))) + "\n"
    )


def test_public_names_and_signatures_are_those_of_the_snapshot() -> None:
    assert public_api() == SNAPSHOT.read_text(), "run `python tests/test_public_api.py` where the change is on purpose"


def test_every_public_name_has_one_home() -> None:
    assert facerelight.__all__ == sorted(facerelight._HOMES)
    for name, home in facerelight._HOMES.items():
        thing = getattr(importlib.import_module(f"facerelight.{home}"), name)
        assert getattr(facerelight, name) is thing
        assert thing.__doc__


def test_no_room_hides_a_public_name() -> None:
    """Importing a module makes its package an attribute of the one above: no room may be called like a public name."""
    rooms = {path.stem for path in Path(facerelight.__file__).parent.iterdir()}
    assert not rooms & set(facerelight.__all__)


if __name__ == "__main__":
    SNAPSHOT.write_text(public_api())
