"""What editors and type checkers are told is what there is."""

import ast
from pathlib import Path

import gift_peft

FOLDER = Path(gift_peft.__file__).parent


def test_the_package_says_that_it_is_typed():
    assert (FOLDER / "py.typed").is_file()


def test_the_stub_has_the_public_names_from_their_homes():
    imports = [node for node in ast.walk(ast.parse((FOLDER / "__init__.pyi").read_text())) if hasattr(node, "names")]
    stub = {name.asname: node.module for node in imports for name in node.names}
    assert stub == {name: f"gift_peft.{home}" for name, home in gift_peft._HOME.items()}
