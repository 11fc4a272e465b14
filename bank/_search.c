/* bank/search.c for Python: holds the arrays of a compressed bank, and searches it for one frame after another.

   The arrays that are handed in have been made by bank/compiled_search.py, which says what they are. Their kinds and sizes and
   whatever points into another one are checked, for they decide where is read. A search keeps the interpreter's lock, so that all
   searches of a bank can use the same memory. */

#include "arrays.h"
#include "search.h"

#include <math.h>
#include <string.h>

/* How the capsule is called in which scipy hands out sgemm: how it begins where its integers have 32 bits, and the type of
   its numbers. */
#define SGEMM_BEGINS "void (char *, char *, int *, int *, int *, "
#define SGEMM_NUMBER "cython_blas_s *"

enum {
    N_ARRAYS = 10,
    MOST_BUFFERS = N_ARRAYS + 3 * (MOST_LEVELS + 1),
    LEAST_CANDIDATES = 1 << 14
};

typedef struct {
    PyObject_HEAD
    Py_buffer held[MOST_BUFFERS];
    int n_held;
    int is_whole; /* all arrays are held, and fit together */
    Bank bank;
} Search;

/* The bank of a search; NULL with an error for one that was never made, or refused. */
static const Bank *bank_of(PyObject *self)
{
    if (((Search *)self)->is_whole)
        return &((Search *)self)->bank;
    PyErr_SetString(PyExc_ValueError, "this search has no bank");
    return NULL;
}

static PyObject *as_tuple(const Found *best, const Found *other)
{
    return Py_BuildValue("ldld", (long)best->cell, best->score, (long)other->cell, other->score);
}

typedef Outcome Find(Hunt *hunt, long most_scores, Found *best, Found *other);

static Outcome find_both_at_lag_0(Hunt *hunt, long most_scores, Found *best, Found *other)
{
    Outcome outcome = find_at_lag_0(hunt, -1, most_scores, best);
    if (outcome == FOUND && other && find_at_lag_0(hunt, best->cell, most_scores, other) == UNDECIDED)
        return UNDECIDED;
    return outcome;
}

static PyObject *matched(PyObject *self, PyObject *args, Find *find)
{
    const Bank *bank = bank_of(self);
    Hunt hunt;
    PyObject *difference;
    int with_runner_up;
    long most_scores;
    Found best = {-1, 0}, other = {-1, 0};
    Taken taken = {.n = 0};
    if (!bank || !PyArg_ParseTuple(args, "Opl", &difference, &with_runner_up, &most_scores))
        return NULL;
    int sound = take(&taken, difference, 'd', CHANNELS) && take_frame(&hunt, bank, taken.values[0]);
    Py_XDECREF(done_or_none(&taken, NULL));
    if (!sound || find(&hunt, most_scores, &best, with_runner_up ? &other : NULL) != FOUND)
        Py_RETURN_NONE;
    return as_tuple(&best, &other);
}

static PyObject *match(PyObject *self, PyObject *args)
{
    return matched(self, args, find_both_at_lag_0);
}

PyDoc_STRVAR(match_doc,
"match(difference, runner_up, most_scores) -> (cell, score, cell, score) | None\n\n"
"Search at lag 0 for a (896,) float64 difference: the best cell and the best one outside its peak, -1 where there is\n"
"none. None: it is no such difference or has no magnitude, a tie hangs on rounding, or more scores would have to be\n"
"computed.");

static PyObject *match_at_all_lags(PyObject *self, PyObject *args)
{
    return matched(self, args, find_at_all_lags);
}

PyDoc_STRVAR(match_at_all_lags_doc,
"match_at_all_lags(difference, runner_up, most_scores) -> (cell, score, cell, score) | None\n\n"
"Search at all lags; as `match`, and None also where there are many bounds to compute, which numpy does quicker, or no\n"
"runner-up.");

/* Σ (difference / noise)², or −1 where a value is not finite or a noise not above zero. */
static double sum_of_squares(const double *values, const double *deviations, Py_ssize_t n)
{
    double sum = 0.0;
    for (Py_ssize_t i = 0; i < n; i++) {
        if (!(isfinite(values[i]) && isfinite(deviations[i]) && deviations[i] > 0))
            return -1.0;
        double ratio = values[i] / deviations[i];
        sum += ratio * ratio;
    }
    return sum;
}

static PyObject *energy(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "dd", SIZES{ANY, AS_FIRST}))
        found = PyFloat_FromDouble(sum_of_squares(taken.values[0], taken.values[1], taken.n_values[0]));
    return done(&taken, found, "an energy is of as many float64 differences as noises");
}

PyDoc_STRVAR(energy_doc,
"energy(difference, noise) -> float\n\n"
"Return the sum of the squares of difference / noise, both float64; -1 where one of them is not sound.");

/* The values of an array of a kind, `n` of them or, below 0, any number, held as long as the search lives; NULL with an error. */
static const void *hold(Search *s, PyObject *array, char kind, Py_ssize_t n)
{
    if (s->n_held == MOST_BUFFERS) {
        PyErr_SetString(PyExc_ValueError, "more arrays than a search holds");
        return NULL;
    }
    Py_buffer *held = &s->held[s->n_held];
    if (!take_array(held, array, kind)) {
        PyErr_Format(PyExc_ValueError, "an array of a bank is in pieces, or not of the kind %c", kind);
        return NULL;
    }
    s->n_held++;
    if (n >= 0 && held->len != n * held->itemsize) {
        PyErr_Format(PyExc_ValueError, "an array of %zd bytes where %zd items of %zd bytes belong", held->len, n, held->itemsize);
        return NULL;
    }
    return held->buf;
}

/* Whether numbers are all below `n_parts`, and none of these is lacking; -1 with an error where there is no memory. */
static int are_all(const int32_t *numbers, Py_ssize_t n, Py_ssize_t n_parts)
{
    Py_ssize_t n_seen = 0;
    char *seen = PyMem_Calloc((size_t)n_parts, 1);
    if (!seen) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        if (numbers[i] < 0 || numbers[i] >= n_parts) {
            n_seen = -1;
            break;
        }
        n_seen += !seen[numbers[i]];
        seen[numbers[i]] = 1;
    }
    PyMem_Free(seen);
    return n_seen == n_parts;
}

static int are_starts(const int32_t *starts, Py_ssize_t n, Py_ssize_t end)
{
    for (Py_ssize_t i = 0; i < n; i++)
        if (starts[i] > starts[i + 1])
            return 0;
    return starts[0] == 0 && starts[n] == end;
}

/* How many items of four bytes the array has that was held last. */
static Py_ssize_t n_of_last(const Search *s)
{
    return s->held[s->n_held - 1].len / 4;
}

static int hold_level(Search *s, PyObject *arrays, Level *level)
{
    PyObject *blocks, *parts, *starts;
    if (!PyArg_ParseTuple(arrays, "OOO", &blocks, &parts, &starts)
        || !(level->parts = hold(s, parts, 'i', -1)))
        return -1;
    level->n = n_of_last(s) / LANES;
    if (!(level->blocks = hold(s, blocks, 'f', level->n * LANES * (s->bank.width + 2)))
        || !(level->starts = hold(s, starts, 'i', -1)))
        return -1;
    level->n_before = n_of_last(s) - 1;
    if (level->n < 1 || level->n_before < 1 || s->held[s->n_held - 3].len != level->n * LANES * 4
        || !are_starts(level->starts, level->n_before, level->n)) {
        PyErr_SetString(PyExc_ValueError, "the blocks of a level's groups are not sound");
        return -1;
    }
    return 0;
}

static int hold_levels(Search *s, PyObject *levels)
{
    Py_ssize_t n = PyTuple_Size(levels) - 1;
    Level *level = s->bank.levels;
    if (n < 1 || n > MOST_LEVELS) {
        PyErr_SetString(PyExc_ValueError, "a search has one level of groups to eight, and the cells");
        return -1;
    }
    for (Py_ssize_t i = 0; i <= n; i++)
        if (hold_level(s, PyTuple_GetItem(levels, i), level + i) < 0)
            return -1;
    for (Py_ssize_t i = 0; i <= n; i++) {
        Py_ssize_t n_parts = i < n ? level[i + 1].n_before : s->bank.n_cells;
        int sound = are_all(level[i].parts, level[i].n * LANES, n_parts);
        if (sound <= 0) {
            if (sound >= 0)
                PyErr_SetString(PyExc_ValueError, "the groups of a level are not the parts of the level before");
            return -1;
        }
    }
    s->bank.n_levels = (int)n;
    return 0;
}

/* Hold the arrays of a bank, in the order of the arguments of `Search`. */
static int hold_bank(Search *s, PyObject *const *arrays, PyObject *levels)
{
    Bank *bank = &s->bank;
    if (!(bank->basis = hold(s, arrays[0], 'f', -1)))
        return -1;
    bank->fine_rank = n_of_last(s) / CHANNELS;
    if (!(bank->norms = hold(s, arrays[4], 'd', -1)))
        return -1;
    bank->n_cells = n_of_last(s) / 2;
    if (!bank->n_cells || bank->n_cells > INT32_MAX) {
        PyErr_SetString(PyExc_ValueError, "a bank without cells, or of more than can be numbered");
        return -1;
    }
    if (bank->coarse_rank < 1 || bank->fine_rank < bank->coarse_rank || bank->fine_rank > MOST_RANK
        || s->held[0].len != bank->fine_rank * CHANNELS * (Py_ssize_t)sizeof(float)) {
        PyErr_SetString(PyExc_ValueError, "the bank's ranks are not sound");
        return -1;
    }
    bank->width = (bank->coarse_rank + LANES - 1) / LANES * LANES;
    if (!(bank->fine = hold(s, arrays[1], 'f', bank->n_cells * (bank->fine_rank + 2)))
        || !(bank->places = hold(s, arrays[3], 'q', bank->n_cells))
        || !(bank->k_of = hold(s, arrays[5], 'i', bank->n_cells))
        || !(bank->sigma_of = hold(s, arrays[6], 'i', bank->n_cells))
        || !(bank->overlaps = hold(s, arrays[7], 'd', 2 * CHANNELS))
        || !(bank->spectra = hold(s, arrays[8], 'f', bank->width * 2 * (HALF + 1)))
        || !(bank->signals = hold(s, arrays[2], 'f', -1)))
        return -1;
    Py_ssize_t n_signals = n_of_last(s) / CHANNELS;
    for (Py_ssize_t i = 0; i < bank->n_cells; i++) {
        if (bank->places[i] < 0 || bank->places[i] >= n_signals) {
            PyErr_SetString(PyExc_ValueError, "a cell's place is not in the signals");
            return -1;
        }
    }
    if (hold_levels(s, levels) < 0
        || !(bank->roots = hold(s, arrays[9], 'f', bank->levels[0].n * LANES * (bank->width + 2))))
        return -1;
    return 0;
}

/* Memory to work in; 0 where there is none. */
static int make_room(Bank *bank)
{
    size_t n_roots = (size_t)bank->levels[0].n * LANES, n_lags = 2 * CHANNELS;
    bank->most_candidates = bank->n_cells > LEAST_CANDIDATES ? bank->n_cells : LEAST_CANDIDATES;
    for (int i = 0; i < bank->n_levels; i++)
        if (bank->most_listed < (bank->levels[i].n + 1) * LANES)
            bank->most_listed = (bank->levels[i].n + 1) * LANES;
    for (int i = 0; i < 2; i++)
        if (!(bank->lists[i] = PyMem_Malloc((size_t)bank->most_listed * sizeof(int32_t))))
            return 0;
    return (bank->candidates = PyMem_Malloc((size_t)bank->most_candidates * sizeof(Candidate)))
        && (bank->root_estimates = PyMem_Malloc(n_roots * sizeof(float)))
        && (bank->root_bounds = PyMem_Malloc(n_roots * sizeof(float)))
        && (bank->bounds = PyMem_Malloc(n_roots * n_lags * sizeof(float)))
        && (bank->columns = PyMem_Malloc(n_lags * (size_t)(bank->width + 2) * sizeof(float)))
        && (bank->points = PyMem_Malloc(HALF * 2 * LANES * sizeof(float)));
}

static int names_sgemm(PyObject *capsule)
{
    const char *name = PyCapsule_CheckExact(capsule) ? PyCapsule_GetName(capsule) : NULL;
    return name && strncmp(name, SGEMM_BEGINS, strlen(SGEMM_BEGINS)) == 0 && strstr(name, SGEMM_NUMBER);
}

static PyObject *is_sgemm(PyObject *module, PyObject *capsule)
{
    (void)module;
    return PyBool_FromLong(names_sgemm(capsule));
}

PyDoc_STRVAR(is_sgemm_doc,
"is_sgemm(capsule) -> bool\n\n"
"Whether a capsule holds BLAS's sgemm as a search calls it: there are such with integers of 64 bits too.");

static int search_init(PyObject *self, PyObject *args, PyObject *named)
{
    Search *s = (Search *)self;
    Bank *bank = &s->bank;
    PyObject *arrays[N_ARRAYS], *levels, *multiply;
    if (s->n_held || (named && PyDict_Size(named))) {
        PyErr_SetString(PyExc_TypeError, "a search is made once, and its arguments have no names");
        return -1;
    }
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOO!Onddddl", &arrays[0], &arrays[1], &arrays[2], &arrays[3], &arrays[4],
                          &arrays[5], &arrays[6], &arrays[7], &arrays[8], &arrays[9], &PyTuple_Type, &levels,
                          &multiply, &bank->coarse_rank, &bank->rounding, &bank->square_rounding, &bank->tie,
                          &bank->tie_rounding, &bank->radius))
        return -1;
    if (!names_sgemm(multiply)) {
        PyErr_SetString(PyExc_TypeError, "this is no sgemm of scipy's");
        return -1;
    }
    if (!(bank->multiply = (Multiply *)PyCapsule_GetPointer(multiply, PyCapsule_GetName(multiply))))
        return -1;
    if (hold_bank(s, arrays, levels) < 0)
        return -1;
    if (!make_room(bank)) {
        PyErr_NoMemory();
        return -1;
    }
    fill_turns(&bank->turns);
    s->is_whole = 1;
    return 0;
}

static void search_dealloc(PyObject *self)
{
    Search *s = (Search *)self;
    PyTypeObject *type = Py_TYPE(self);
    while (s->n_held)
        PyBuffer_Release(&s->held[--s->n_held]);
    PyMem_Free(s->bank.candidates);
    PyMem_Free(s->bank.root_estimates);
    PyMem_Free(s->bank.root_bounds);
    PyMem_Free(s->bank.lists[0]);
    PyMem_Free(s->bank.lists[1]);
    PyMem_Free(s->bank.bounds);
    PyMem_Free(s->bank.columns);
    PyMem_Free(s->bank.points);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef search_methods[] = {
    {"match", match, METH_VARARGS, match_doc},
    {"match_at_all_lags", match_at_all_lags, METH_VARARGS, match_at_all_lags_doc},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot search_slots[] = {
    {Py_tp_doc, "A compressed bank that is searched; see bank/compiled_search.py."},
    {Py_tp_init, search_init},
    {Py_tp_dealloc, search_dealloc},
    {Py_tp_methods, search_methods},
    {0, NULL},
};

static PyType_Spec search_spec = {
    .name = "bank._search.Search",
    .basicsize = sizeof(Search),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = search_slots,
};

static PyMethodDef module_functions[] = {
    {"energy", energy, METH_VARARGS, energy_doc},
    {"is_sgemm", is_sgemm, METH_O, is_sgemm_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "bank._search",
    .m_doc = "What matchers do with many calls of numpy, in one.",
    .m_size = -1,
    .m_methods = module_functions,
};

PyMODINIT_FUNC PyInit__search(void)
{
    PyObject *found = PyModule_Create(&module);
    PyObject *type = found ? PyType_FromSpec(&search_spec) : NULL;
    if (!type || PyModule_AddObjectRef(found, "Search", type) < 0
        || PyModule_AddIntConstant(found, "SOURCES", SOURCES) < 0) {
        Py_XDECREF(found);
        found = NULL;
    }
    Py_XDECREF(type);
    return found;
}
