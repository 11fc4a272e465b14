"""Partial Cholesky factorisation of several matrices at once, compiled by numba: the arithmetic of `elimination`.

Several matrices stand side by side, one per lane of a vector register, and entries are processed in small tiles. numba
has no vector type, and its loops over the last axis of an array do not stay in registers. So this module defines one:
an array (n, LANES) of doubles holds n entries; `_load` and `_store` move one of them, `_load_column` and
`_store_column` as many as a tile has rows. Vectors can be added, subtracted and multiplied, lane by lane.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from llvmlite import ir
from numba import njit
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray

# Fronts are stored in tiles of this many rows and columns, on and below the diagonal, one row of tiles after the other.
# A tile holds its columns one after the other: entry (i, j) is at row_start(i) + TILE · j.
TILE = 4
# Eight doubles fill a register of AVX-512; elsewhere a register holds four at most. The width follows from the
# processor that numba compiles for, which also selects its cache: machines that share a folder must not run each
# other's code on arrays of another width.
_, _, _FEATURES = cpu_target.target_context.codegen().magic_tuple()
LANES: Final = 8 if "+avx512f" in _FEATURES.split(",") else 4
_F = TypeVar("_F", bound=Callable[..., Any])
_DOUBLE, _INDEX = ir.DoubleType(), ir.IntType(32)


class Plan(NamedTuple):
    """The steps of an elimination, front by front; the last front holds the kept unknowns.

    Places are entries of the memory that all fronts share.
    fronts: each begins at `base` and has the rows from `first` to `size`; those before `end` are pivots. Rows before
    `first` are empty, so that `end` is the start of a tile. `tile_row` is its first tile row among all.
    tile_rows: where the terms and arrivals of each begin, with one more for their end.
    terms: each adds value · factors[source] at `place`.
    arrivals: each adds `length` entries of an earlier front, TILE apart from `source`, at the distances
    columns[column], columns[column + 1], … from `target`.
    """

    fronts: NDArray[np.void]
    tile_rows: NDArray[np.void]
    terms: NDArray[np.void]
    arrivals: NDArray[np.void]
    columns: NDArray[np.int32]


class _Lanes(types.Type):
    """Some entries, each of LANES doubles."""

    def __init__(self, entries: int) -> None:
        super().__init__(name=f"Lanes({entries})")
        self.vector = ir.VectorType(_DOUBLE, entries * LANES)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]  # numba's types are not all known
    def __init__(self, manager: Any, kind: _Lanes) -> None:
        super().__init__(manager, kind, kind.vector)


_ONE, _COLUMN = _Lanes(1), _Lanes(TILE)


def _pointer(context: Any, builder: Any, signature: Any, given: Sequence[Any], kind: _Lanes) -> Any:
    array, entry = context.make_array(signature.args[0])(context, builder, given[0]), given[1]
    first = builder.gep(array.data, [builder.mul(entry, entry.type(LANES))], inbounds=True)
    return builder.bitcast(first, kind.vector.as_pointer())


def _loading(kind: _Lanes) -> Any:
    def make(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, given, kind), align=_DOUBLE_BYTES)

    def typed(_: Any, array: Any, entry: Any) -> Any:  # noqa: ARG001 - numba calls it with the types
        return kind(array, types.intp), make

    return intrinsic(typed)


def _storing(kind: _Lanes) -> Any:
    def make(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        builder.store(given[2], _pointer(context, builder, signature, given, kind), align=_DOUBLE_BYTES)
        return context.get_dummy_value()

    def typed(_: Any, array: Any, entry: Any, value: Any) -> Any:  # noqa: ARG001 - as above
        return types.void(array, types.intp, kind), make

    return intrinsic(typed)


# The alignment that numpy guarantees.
_DOUBLE_BYTES = 8
_load, _load_column = _loading(_ONE), _loading(_COLUMN)
_store, _store_column = _storing(_ONE), _storing(_COLUMN)


def _rooting(_: Any, value: Any) -> Any:  # noqa: ARG001 - as above
    """Return 1/√ of one entry."""

    def make(_: Any, builder: Any, __: Any, given: Any) -> Any:
        of = ir.FunctionType(_ONE.vector, [_ONE.vector])
        root = cgutils.get_or_insert_function(builder.module, of, f"llvm.sqrt.v{LANES}f64")
        return builder.fdiv(ir.Constant(_ONE.vector, [1.0] * LANES), builder.call(root, given))

    return _ONE(_ONE), make


_inverse_root = intrinsic(_rooting)


def _repeated(builder: Any, value: Any, times: Sequence[int]) -> Any:
    """Return a vector of the elements at `times` of another."""
    pick = ir.Constant(ir.VectorType(_INDEX, len(times)), list(times))
    return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), pick)


def _widened(builder: Any, value: Any, kind: _Lanes) -> Any:
    """Return a number, or one entry, repeated to the width of a wider value."""
    if value.type == _DOUBLE:
        one = builder.insert_element(ir.Constant(kind.vector, ir.Undefined), value, _INDEX(0))
        return _repeated(builder, one, [0] * kind.vector.count)
    return _repeated(builder, value, [lane % LANES for lane in range(kind.vector.count)])


def _define(sign: Callable[[Any, Any], Any], instruction: str, *cases: tuple[Any, Any, Any]) -> None:
    """Define left `sign` right in numba, for some (left, right, result)."""

    def make(_: Any, builder: Any, signature: Any, given: Any) -> Any:
        kind = signature.return_type
        wide = [value if value.type == kind.vector else _widened(builder, value, kind) for value in given]
        # A product and a difference may be fused.
        return getattr(builder, instruction)(*wide, flags=("contract",))

    def typed(_: Any) -> Any:
        return lambda left, right: next((kind for *operands, kind in cases if operands == [left, right]), None)

    type_callable(sign)(typed)
    for left, right, _kind in cases:
        lower_builtin(sign, left, right)(make)


_define(operator.add, "fadd", (_ONE, _ONE, _ONE))
_define(operator.sub, "fsub", (_COLUMN, _COLUMN, _COLUMN))
_define(operator.mul, "fmul", (_COLUMN, _ONE, _COLUMN), (types.float64, _ONE, _ONE))


def _compiled(function: _F) -> _F:
    """Compile a function and cache the result on the disk where that is possible.

    Products and sums may be fused, nothing reordered. The interpreter's lock is released: threads run in parallel.
    """
    options: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}}
    try:
        compiled: _F = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache is writable
        compiled = njit(**options)(function)
    return compiled


@_compiled
def schur_complements(plan: Plan, factors: FloatArray, lanes: FloatArray, work: FloatArray, left: FloatArray) -> None:
    """Write the Schur complements (n, kept, kept) of n matrices to `left`, for (n, F) factors; factor F is 1.

    `lanes` (F + 1, LANES) and `work` (entries of the plan, LANES) are scratch memory.
    """
    lanes[-1] = 1.0
    for begin in range(0, len(factors), LANES):
        for factor in range(factors.shape[1]):
            for lane in range(LANES):
                # The last group may have fewer matrices than lanes.
                lanes[factor, lane] = factors[min(begin + lane, len(factors) - 1), factor]
        for front in plan.fronts:
            for row in range(0, front.size, TILE):
                at = front.base + _row_start(row)
                work[at : at + TILE * (row + TILE)] = 0.0
                _assemble(plan, front.tile_row + row // TILE, lanes, work)
                _factor(work, front.base, row, front.first, front.end)
        # The last front has no pivots.
        for matrix in range(begin, min(begin + LANES, len(factors))):
            for row in range(plan.fronts[-1].size):
                at = plan.fronts[-1].base + _row_start(row)
                for column in range(row + 1):
                    left[matrix, row, column] = left[matrix, column, row] = work[at + TILE * column, matrix - begin]


@_compiled
def _row_start(row: int) -> int:
    tiles = row // TILE
    return TILE * TILE // 2 * tiles * (tiles + 1) + row % TILE


@_compiled
def _assemble(plan: Plan, tile_row: int, lanes: FloatArray, work: FloatArray) -> None:
    """Assemble a row of tiles: its own terms, and the remainders of earlier fronts."""
    begin, end = plan.tile_rows[tile_row], plan.tile_rows[tile_row + 1]
    for term in plan.terms[begin.term : end.term]:
        _store(work, term.place, _load(work, term.place) + term.value * _load(lanes, term.source))
    for some in plan.arrivals[begin.arrival : end.arrival]:
        for j in range(some.length):
            at = some.target + plan.columns[some.column + j]
            _store(work, at, _load(work, at) + _load(work, some.source + TILE * j))


@_compiled
def _factor(work: FloatArray, base: int, row: int, first: int, end: int) -> None:
    """Factorise a row of tiles: the Cholesky factor in the pivots' columns, the remainder in the others.

    Row by row, so that a row stays in the nearest cache. All earlier rows are finished.
    """
    left = base + _row_start(row)
    for column in range(0, row + 1, TILE):
        right = base + _row_start(column)
        stop = min(column, end)
        if stop > first:
            _subtract_products(work, left, right, left + TILE * column, first, stop)
        if column < end:
            _divide(work, left + TILE * column, right + TILE * column, max(first - column, 0))


@_compiled
def _subtract_products(work: FloatArray, left: int, right: int, at: int, first: int, stop: int) -> None:
    """Subtract from the tile at `at` the products of two rows of tiles, in the columns from `first` to `stop`."""
    a, b, c, d = (
        _load_column(work, at),
        _load_column(work, at + 4),
        _load_column(work, at + 8),
        _load_column(work, at + 12),
    )
    for step in range(TILE * first, TILE * stop, TILE):
        column = _load_column(work, left + step)
        a = a - column * _load(work, right + step)
        b = b - column * _load(work, right + step + 1)
        c = c - column * _load(work, right + step + 2)
        d = d - column * _load(work, right + step + 3)
    _store_column(work, at, a)
    _store_column(work, at + 4, b)
    _store_column(work, at + 8, c)
    _store_column(work, at + 12, d)


@_compiled
def _divide(work: FloatArray, at: int, diagonal: int, first: int) -> None:
    """Divide a tile's columns, from `first`, by the Cholesky factor of the diagonal tile; compute it on the diagonal.

    The factor stores inverses on its own diagonal.
    """
    for column in range(first, TILE):
        found = _load_column(work, at + TILE * column)
        for before in range(first, column):
            found = found - _load_column(work, at + TILE * before) * _load(work, diagonal + TILE * before + column)
        if at == diagonal:
            _store_column(work, at + TILE * column, found)
            pivot = _inverse_root(_load(work, at + TILE * column + column))
            _store_column(work, at + TILE * column, found * pivot)
            _store(work, at + TILE * column + column, pivot)
        else:
            _store_column(work, at + TILE * column, found * _load(work, diagonal + TILE * column + column))
