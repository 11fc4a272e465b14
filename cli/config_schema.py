"""JSON Schemas of the files that people write, from the models that read them."""

import importlib
import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from shearloop.units import unit_of

# Module and class that read each kind of file.
MODELS = {
    "configuration": ("shearloop.daemon.config", "DaemonConfig"),
    "experiment": ("shearloop.daemon.control.experiment_schema", "ExperimentFile"),
    "robot": ("shearloop.drivers.ur.settings", "UrSettings"),
    "bank": ("shearloop.tools.bank_config", "BankConfig"),
    "fingertip": ("shearloop.tools.bank_config", "FingertipGeometryConfig"),
}


class _Untitled(GenerateJsonSchema):
    """Leaves out the titles of keys, which repeat their names."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - pydantic passes it
        """Return False for every key."""
        return False


class Section(NamedTuple):
    """A section of a file: its paths in the file, and its schema."""

    paths: list[str]
    schema: dict[str, Any]


def schema_of(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of file; descriptions end with the unit in brackets."""
    module, name = MODELS[kind]
    schema = TypeAdapter(getattr(importlib.import_module(module), name)).json_schema(schema_generator=_Untitled)
    for section in (schema, *schema.get("$defs", {}).values()):
        for key, described in section.get("properties", {}).items():
            if "const" in described:
                described["description"] = section["description"]
            elif unit := unit_of(key):
                described["description"] += f" [{unit}]"
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": f"shearloop: {kind}"}


def schema_text(kind: str) -> str:
    """Return the JSON Schema of a kind of file as indented JSON."""
    return json.dumps(schema_of(kind), indent=2, ensure_ascii=False) + "\n"


def sections(schema: dict[str, Any]) -> list[Section]:
    """Return every section of a schema once, the outermost first."""
    found = {"": Section([""], schema)}

    def visit(path: str, section: dict[str, Any]) -> None:
        for key, described in section["properties"].items():
            for suffix, reference in references(described):
                inner = schema["$defs"][reference]
                inner_path = f"{path}.{key}{suffix}".lstrip(".")
                if kind := inner["properties"].get("do", {}).get("const"):
                    inner_path = f"do: {kind}"
                if reference in found:
                    if inner_path not in found[reference].paths:
                        found[reference].paths.append(inner_path)
                    continue
                found[reference] = Section([inner_path], inner)
                visit("steps[]" if kind else inner_path, inner)

    visit("", schema)
    return list(found.values())


def references(described: Mapping[str, Any], suffix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the sections within a key: what follows the key in a path (`.NAME`, `[]`), and the section's name."""
    if "$ref" in described:
        yield suffix, described["$ref"].rpartition("/")[2]
    for inner in (*described.get("anyOf", ()), *described.get("oneOf", ())):
        yield from references(inner, suffix)
    for inner in described.get("patternProperties", {}).values():
        yield from references(inner, f"{suffix}.NAME")
    if "items" in described:
        yield from references(described["items"], f"{suffix}[]")
