"""The arithmetic of `shearloop.bank.eit.elimination`, compiled: several matrices side by side, on small tiles of
their entries.

All that numba compiles is in this file, for what it keeps on the disk is made anew when this file changes.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

from llvmlite import ir
from numba import config, njit
from numba.core import cgutils, types
from numba.core.caching import FunctionCache
from numba.core.registry import cpu_target
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.fronts import TILE, Plan
from shearloop.bank.errors import BankError

_F = TypeVar("_F", bound=Callable[..., Any])

# One number of each of several matrices is a value of its own here, which a vector register holds. numba has no such
# type, and what it makes of loops over the last axis of an array does not stay in registers. An array (n, LANES) of
# doubles holds n entries: `_load` and `_store` move one of them, `_load_column` and `_store_column` as many as a tile
# has rows. Such values can be added, subtracted and multiplied, each lane on its own.

# Eight doubles are a register of AVX-512. Elsewhere a register holds four at most, and there are half as many of them.
# What numba keeps on the disk is found by the processor it compiles for, which NUMBA_CPU_NAME may say. If that did not
# decide alone, machines that share a folder would run each other's code on arrays of another width, unchecked.
_, _, _FEATURES = cpu_target.target_context.codegen().magic_tuple()
LANES: Final = 8 if "+avx512f" in _FEATURES.split(",") else 4
_DOUBLE, _INDEX = ir.DoubleType(), ir.IntType(32)


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


# What numpy promises of an array of doubles; whoever wants speed begins arrays where a cache line begins.
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
    """Return a vector of those elements of another."""
    pick = ir.Constant(ir.VectorType(_INDEX, len(times)), list(times))
    return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), pick)


def _widened(builder: Any, value: Any, kind: _Lanes) -> Any:
    """Return a number, or one entry, as often as a wider value has room for it."""
    if value.type == _DOUBLE:
        one = builder.insert_element(ir.Constant(kind.vector, ir.Undefined), value, _INDEX(0))
        return _repeated(builder, one, [0] * kind.vector.count)
    return _repeated(builder, value, [lane % LANES for lane in range(kind.vector.count)])


def _define(sign: Callable[[Any, Any], Any], instruction: str, *cases: tuple[Any, Any, Any]) -> None:
    """Teach numba what left sign right is, for some (left, right, result)."""

    def make(_: Any, builder: Any, signature: Any, given: Any) -> Any:
        kind = signature.return_type
        wide = [value if value.type == kind.vector else _widened(builder, value, kind) for value in given]
        # A product and a difference may be one instruction, as everywhere in `shearloop.bank.eit.elimination`.
        return getattr(builder, instruction)(*wide, flags=("contract",))

    def typed(_: Any) -> Any:
        return lambda left, right: next((kind for *operands, kind in cases if operands == [left, right]), None)

    type_callable(sign)(typed)
    for left, right, _kind in cases:
        lower_builtin(sign, left, right)(make)


_define(operator.add, "fadd", (_ONE, _ONE, _ONE))
_define(operator.sub, "fsub", (_COLUMN, _COLUMN, _COLUMN))
_define(operator.mul, "fmul", (_COLUMN, _ONE, _COLUMN), (types.float64, _ONE, _ONE))


def require_compiler() -> None:
    """Raise BankError where numba was told to compile nothing: Python itself cannot add such values."""
    if config.DISABLE_JIT:
        raise BankError(
            "the environment variable NUMBA_DISABLE_JIT is set, and a bank's cells are solved by compiled code alone; "
            "unset it"
        )


class _Cache(FunctionCache):  # type: ignore[misc]  # numba's types are not all known
    """What numba keeps of a function; a file of it that was cut short, or is another's, counts as none."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was kept for a signature; None where nothing was, or nothing that can be read."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001 - a damaged pickle may raise anything, and everything is made anew
            # The index may be what is damaged, and is read again before it is written.
            self.flush()
            return None


def _compiled(function: _F) -> _F:
    """Compile a function, and keep the result on the disk where there is a place for it."""
    # Products and differences may be fused; nothing else may be reordered. Without the lock of the interpreter, several
    # threads eliminate at once.
    options: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}}
    try:
        cache = _Cache(function)
    except RuntimeError:  # neither beside this file nor in the user's cache may anything be written
        cache = None
    compiled = njit(**options)(function)
    if cache is not None:
        # As `cache=True` does it, which has no place for another cache than its own.
        compiled._cache = cache
    kept: _F = compiled
    return kept


@_compiled
def schur_complements(plan: Plan, factors: FloatArray, lanes: FloatArray, work: FloatArray, left: FloatArray) -> None:
    """Put into `left` what is left of n matrices, (n, kept, kept), for (n, F) factors; factor F is 1.

    `lanes`, (F + 1, LANES), and `work`, (entries of the plan, LANES), are memory to work in.
    """
    lanes[-1] = 1.0
    for begin in range(0, len(factors), LANES):
        for factor in range(factors.shape[1]):
            for lane in range(LANES):
                # The last matrices may be fewer than there are lanes.
                lanes[factor, lane] = factors[min(begin + lane, len(factors) - 1), factor]
        for front in plan.fronts:
            for row in range(0, front.size, TILE):
                at = front.base + _row_start(row)
                work[at : at + TILE * (row + TILE)] = 0.0
                _assemble(plan, front.tile_row + row // TILE, lanes, work)
                _factor(work, front.base, row, front.first, front.end)
        # Nothing of the last front was eliminated.
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
    """Add up what a row of tiles is made of: its own terms, and what fronts before leave."""
    begin, end = plan.tile_rows[tile_row], plan.tile_rows[tile_row + 1]
    for term in plan.terms[begin.term : end.term]:
        _store(work, term.place, _load(work, term.place) + term.value * _load(lanes, term.source))
    for some in plan.arrivals[begin.arrival : end.arrival]:
        for j in range(some.length):
            at = some.target + plan.columns[some.column + j]
            _store(work, at, _load(work, at) + _load(work, some.source + TILE * j))


@_compiled
def _factor(work: FloatArray, base: int, row: int, first: int, end: int) -> None:
    """Bring a row of tiles up to date: Cholesky's factor in the pivots' columns, and what these leave in the others.

    By rows, so that a row is assembled, changed and done while it is in the nearest cache. All rows before are done.
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
    """Divide a tile's columns, from `first`, by Cholesky's factor on the diagonal of its column; make it if it is that.

    The factor has inverse numbers on its own diagonal.
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
