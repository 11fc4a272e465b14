"""Explains the syntax errors of YAML files, and proposes the file that was probably meant."""

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from shearloop.binary_files import IN_UTF_16, is_utf_16
from shearloop.files import read_file
from shearloop.lookalikes import describe, first_lookalike, without_lookalikes
from shearloop.mistakes import keys_of
from shearloop.words import counted
from shearloop.yaml_loader import MAX_BYTES, MISREAD, parse_yaml

_SUFFIXES = (".yaml", ".yml")
# The number of files with near names that are read, to find which may be meant.
_LOOKED_AT = 5
# The library's words for frequent mistakes, and ours.
_SYNTAX = (
    ("found character '\\t'", "a tab indents this line; use spaces"),
    ("could not find expected ':'", "a key without its `:`"),
    ("found unexpected end of stream", "the quote that opens here is not closed"),
    ("found unknown escape", "a backslash in double quotes has a meaning of its own; use single quotes"),
    ("expected escape sequence", "a backslash in double quotes has a meaning of its own; use single quotes"),
    ("expected a comment or a line break", "`>` and `|` begin a text of several lines; put this text in quotes"),
    ("found unhashable key", "a key is a list or a section; a name is expected"),
    ("could not determine a constructor", "the keys `<<` and `=` are not supported"),
    ("but found another document", "a second document begins here; a file has one"),
    ("found undefined alias", "an alias `*name` without its anchor `&name`"),
)
# Errors that the library sees only after their cause, which is where it began to read.
_BEGAN_BEFORE = ("could not find expected ':'", "found unexpected end of stream")
_CANNOT_BEGIN = re.compile(r"found character '(.)' that cannot start any token")
_KEY = r"(?P<before>\s*(?:- +)*\{?)(?P<key>[a-z]\w*)"


class _Cure(NamedTuple):
    """A change of one line that may cure a syntax error, and the cause in words."""

    wrong: re.Pattern[str]
    right: str
    words: str


_CURES = (
    _Cure(re.compile(r"^ *```.*$"), "", "a fence of Markdown; take this line out"),
    _Cure(re.compile(r"^(<<<<<<<|=======|>>>>>>>).*$"), "", "a mark of a merge conflict; keep one side, without marks"),
    _Cure(
        re.compile(r"^(?P<before> *)(?P<key>)(\*|\+|--|[0-9]+[.)])(?= +\S)"),
        r"\g<before>-",
        "an entry begins with `- `",
    ),
    _Cure(re.compile(r"^(?P<before> *- +)(?P<key>)(?=[a-z]\w*:[^{]*\} *$)"), r"\g<before>{", "a `{` is missing"),
    _Cure(re.compile(rf"^{_KEY}:(?=[^\s:])"), r"\g<before>\g<key>: ", "a space is missing behind the `:`"),
    _Cure(re.compile(rf"^{_KEY} *= *"), r"\g<before>\g<key>: ", "a `:` is missing; write it instead of `=`"),
    _Cure(re.compile(r"^(?P<before> *)(?P<key>-)(?=[A-Za-z{])"), r"\g<before>- ", "a space is missing behind the `-`"),
    _Cure(re.compile(rf"^{_KEY}(?= +[^ :]| *$)"), r"\g<before>\g<key>: ", "a `:` is missing behind the key"),
    _Cure(re.compile(r"; *(?=[a-z]\w*:)"), ", ", "a `,` is missing; write it instead of `;`"),
    _Cure(re.compile(r"(?<=[\w}\]\"']) +(?=[a-z]\w*: )"), ", ", "a `,` is missing"),
)
# A cure is tried in this number of lines up to the error, and in files with up to this number of characters before it:
# each trial reads the file again, up to there.
_LINES_TRIED, _LONGEST_TRIED, _MOST_TRIALS = 4, 8_000, 24
# As YAML counts lines.
_LINE_END = re.compile("\r\n|[\r\n\x85\u2028\u2029]")


def syntax(error: yaml.YAMLError, text: str) -> str:
    """Return the syntax error of a text in words."""
    return _explained(error, text)[1]


def place_and_syntax(error: yaml.YAMLError, text: str) -> str:
    """Return the place of the syntax error of a text, as `:line:column`, and the error in words."""
    return ": ".join(_explained(error, text))


def _explained(error: yaml.YAMLError, text: str) -> tuple[str, str]:
    """Return the place of the syntax error of a text, as `:line:column`, and the error in words."""
    if not isinstance(error, yaml.MarkedYAMLError):
        return _no_character(error, text)
    problem = str(error.problem or error.context)
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return "", problem
    if problem == MISREAD:
        return _lookalike(text, mark.index)
    lines = _LINE_END.split(text)
    if (cured := _cured(lines, error, mark)) is not None:
        return cured
    if error.context_mark is not None and problem.startswith(_BEGAN_BEFORE):
        mark = error.context_mark
    return f":{mark.line + 1}:{mark.column + 1}", _words(error, problem, lines[mark.line][: mark.column])


def _no_character(error: yaml.YAMLError, text: str) -> tuple[str, str]:
    """Return the place and the words for a character that no text may have."""
    if not isinstance(error, yaml.reader.ReaderError):
        return "", " ".join(str(error).split())
    if is_utf_16(text.encode()):
        return "", IN_UTF_16
    return _place(text, error.position), f"U+{error.character:04X} is no character of a text; take it out"


def _place(text: str, index: int) -> str:
    """Return the place of a character in a text, as `:line:column`."""
    before = _LINE_END.split(text[:index])
    return f":{len(before)}:{len(before[-1]) + 1}"


def _lookalike(text: str, index: int) -> tuple[str, str]:
    """Return the place and the words for the first lookalike from an index on."""
    index += first_lookalike(text[index:]) or 0
    return _place(text, index), describe(text[index])


def _cured(lines: Sequence[str], error: yaml.MarkedYAMLError, mark: yaml.Mark) -> tuple[str, str] | None:
    """Return the place and the cause of an error that a trial cures, None if no trial does."""
    if mark.index > _LONGEST_TRIED or not isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError):
        return None
    numbers = [*range(mark.line, max(mark.line - _LINES_TRIED, -1), -1)]
    if error.context_mark is not None and error.context_mark.line not in numbers:
        numbers.append(error.context_mark.line)
    written = [number for number in numbers if number < len(lines) and not re.match(r"\s*(#|$)", lines[number])]
    # A line is moved only where nothing in the lines is wrong.
    trials = [(number, *cure) for number in written for cure in _cures_of(lines[number])]
    trials += [(number, *cure) for number in written[:1] for cure in _moved(lines, number)]
    for number, column, line, words in trials[:_MOST_TRIALS]:
        if _reads_further([*lines[:number], line, *lines[number + 1 : mark.line + 1]], mark):
            return f":{number + 1}:{column + 1}", words
    return None


def _cures_of(line: str) -> Iterator[tuple[int, str, str]]:
    """Yield other spellings of a line: the column where it differs, the line, and the cause in words."""
    if (column := first_lookalike(line)) is not None:
        yield column, without_lookalikes(line), describe(line[column])
    for cure in _CURES:
        if found := cure.wrong.search(line):
            column = found.end("key") if "key" in cure.wrong.groupindex else found.start()
            yield column, cure.wrong.sub(cure.right, line, count=1), cure.words


def _moved(lines: Sequence[str], number: int) -> Iterator[tuple[int, str, str]]:
    """Yield a line as an entry of a list, and with the indentation of the lines above, as `_cures_of` does."""
    text = lines[number].lstrip(" ")
    blank, begins = len(lines[number]) - len(text), re.match(r"\{?(\w*)", text)
    for above in reversed(lines[max(0, number - _LINES_TRIED) : number]):
        entry = re.match(r"( *- +)\{?(\w*)", above)
        if entry is not None and begins is not None and entry[2] == begins[1]:
            yield blank, entry[1] + text, "a `-` is missing before this entry"
        indents = [len(above) - len(above.lstrip(" "))]
        if entry is not None:
            indents.append(len(entry[1]))
        for other in indents:
            words = f"this line is indented by {counted(blank, 'space')}, and a line above by {other}"
            yield blank, " " * other + text, words


def _reads_further(lines: Sequence[str], mark: yaml.Mark) -> bool:
    """Return whether lines can be read beyond a mark; the last of them ends with its line."""
    try:
        for _ in yaml.parse("\n".join(lines), yaml.SafeLoader):
            pass
    except yaml.MarkedYAMLError as error:
        found = error.problem_mark or error.context_mark
        return found is not None and (found.line, found.column) > (mark.line, len(lines[-1]))
    except (yaml.YAMLError, RecursionError):
        return False
    return True


def _words(error: yaml.MarkedYAMLError, problem: str, before: str) -> str:
    """Return an error in words; `before` is its line up to it."""
    if found := _CANNOT_BEGIN.match(problem):
        return f"no value begins with {found[1]}; put it in quotes"
    if r"'\t'" in problem and before.strip():
        return "a tab stands in this line; use spaces"
    if re.match(r"the key `[0-9]+` is given twice", problem):
        return f"{problem}; a `,` begins another key, so write a point"
    opened = error.context_mark
    for begin, what, end in (("expected ',' or ']'", "list", "]"), ("expected ',' or '}'", "section", "}")):
        if problem.startswith(begin):
            where = f"; it begins in line {opened.line + 1}" if opened is not None else ""
            return f"a {what} is not closed: `,` or `{end}` is missing{where}"
    if problem.startswith("mapping values are not allowed"):
        if re.search(r"\S:\s", before):
            return "a second `:` stands in this line; put the text in quotes"
        return "this line is indented deeper than the one before, which has a value already"
    if problem.startswith("expected <block end>"):
        if closing := re.search(r"'([\]}])'", problem):
            return f"a `{closing[1]}` too many"
        if before.strip(" -"):
            return "something stands behind the value; take it out, or put the whole text in double quotes"
        if "collection" in str(error.context):
            return "this line does not begin with `- ` as those above, or is indented otherwise"
        return "this line is indented otherwise than those above"
    return next((words for begin, words in _SYNTAX if problem.startswith(begin)), problem)


def meant(path: Path, model: type[Any] | None) -> str:
    """Return which YAML file was probably meant by the path of a folder, or of no file; empty where none is near.

    A path in a file counts from this file's folder. Where it was written as the shell has it, the folder stands twice
    in it, and the file of this name is above.
    """
    folder = path if path.is_dir() else path.parent
    try:
        names = sorted(one.name for one in folder.iterdir() if one.suffix in _SUFFIXES)
    except OSError:
        names = []
    if folder is path:
        # A folder of `init` has its configuration under this name.
        near = ["rig.yaml"] if "rig.yaml" in names else names
    else:
        near = get_close_matches(path.name, [name for name in names if name != path.name], _LOOKED_AT)
    found = [folder / name for name in near[:_LOOKED_AT]]
    if folder is not path:
        found += [above for parent in folder.parents if (above := parent / path.name).is_file()]
    found = [one for one in found if model is None or _may_be(one, model)]
    return f"; did you mean {found[0]}?" if found else ""


def _may_be(path: Path, model: type[Any]) -> bool:
    """Return whether a file may be meant for a model: most of its keys are the model's, or it cannot be known."""
    try:
        content = parse_yaml(read_file(path, MAX_BYTES))
    except OSError:
        return False
    except (yaml.YAMLError, ValueError, RecursionError):
        return True
    if content is None:
        return True
    return isinstance(content, dict) and 2 * sum(key in keys_of(model) for key in content) >= len(content)
