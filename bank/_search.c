/* bank/search.c for Python: holds the arrays of a compressed bank, and searches it for one frame after another.

   The arrays that are handed in have been made by bank/compiled.py, which says what they are. Their sizes and whatever
   points into another one are checked, for they decide where is read. A search keeps the interpreter's lock, except while
   Python computes transforms for it, so that all searches of a bank can use the same memory. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "search.h"

#include <math.h>
#include <string.h>

/* How the capsule is called in which scipy hands out sgemm: how it begins where its integers have 32 bits, and the type of
   its numbers. */
#define SGEMM_BEGINS "void (char *, char *, int *, int *, int *, "
#define SGEMM_NUMBER "cython_blas_s *"

enum {
    MOST_BUFFERS = 10 + 3 * MOST_LEVELS,
    LEAST_CANDIDATES = 1 << 14,
    /* Of so few lags, products with the basis cost less than transforms by numpy, when these come cold. */
    FEW_LAGS = 128
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

static PyObject *match(PyObject *self, PyObject *args)
{
    const Bank *bank = bank_of(self);
    Hunt hunt;
    Py_buffer difference;
    int with_runner_up;
    long most_scores;
    Found best = {-1, 0}, other = {-1, 0};
    if (!bank || !PyArg_ParseTuple(args, "y*pl", &difference, &with_runner_up, &most_scores))
        return NULL;
    int sound = difference.len == CHANNELS * sizeof(double) && take_frame(&hunt, bank, difference.buf);
    PyBuffer_Release(&difference);
    if (!sound || find_at_lag_0(&hunt, -1, most_scores, &best) != FOUND)
        Py_RETURN_NONE;
    if (with_runner_up && find_at_lag_0(&hunt, best.cell, most_scores, &other) == UNDECIDED)
        Py_RETURN_NONE;
    return as_tuple(&best, &other);
}

PyDoc_STRVAR(match_doc,
"match(difference, runner_up, most_scores) -> (cell, score, cell, score) | None\n\n"
"Search at lag 0 for a (896,) float64 difference: the best cell and the best one outside its peak, -1 where there is\n"
"none. None: the difference has no magnitude, a tie hangs on rounding, or more scores would have to be computed.");

/* What the frame's numbers are at some lags, by Python: `correlate` has the transforms. Held until it is released. */
static int correlated(PyObject *correlate, const Hunt *hunt, int first, int end, Py_buffer *parts)
{
    PyObject *made = PyObject_CallFunction(correlate, "y#ii", (const char *)(hunt->single + CHANNELS),
                                           (Py_ssize_t)(CHANNELS * sizeof(float)), first, end);
    int failed = !made || PyObject_GetBuffer(made, parts, PyBUF_C_CONTIGUOUS) < 0;
    Py_XDECREF(made);
    if (failed)
        return 0;
    if (parts->len != hunt->bank->coarse_rank * (end - first) * (Py_ssize_t)sizeof(float)) {
        PyBuffer_Release(parts);
        PyErr_SetString(PyExc_ValueError, "a frame's numbers are not those of the lags that were asked for");
        return 0;
    }
    return 1;
}

/* The highest score that is known of a cell outside the peak of another; -1 where none is. */
static double highest_apart(const Bank *bank, const Found *known, int n, int32_t cell)
{
    double highest = -1;
    for (int i = 0; i < n; i++)
        if (!in_peak_of(bank, known[i].cell, cell) && known[i].score > highest)
            highest = known[i].score;
    return highest;
}

/* Find the best cell at all lags and, if one is wanted, the runner-up. */
static Outcome find_at_all_lags(Hunt *hunt, const float *parts, int first, int end, int with_runner_up,
                                long most_scores, Found *known, Found *best, Found *other)
{
    const Bank *bank = hunt->bank;
    double left_out_below = known[with_runner_up].score;
    take_lags(hunt, parts, first, end);
    int lag = likeliest_lag(hunt, left_out_below);
    if (lag < 0)
        return UNDECIDED;
    /* The higher the scores that are known to be reached, the less is left to look at. */
    int n = 1 + with_runner_up;
    *best = known[0];
    if (first + lag != 0) { /* lag 0 has been looked at */
        if (find_at_lag(hunt, lag, -1, most_scores, &known[n]) != FOUND)
            return UNDECIDED;
        if (known[n].score > best->score)
            *best = known[n];
        n++;
        if (with_runner_up && find_at_lag(hunt, lag, best->cell, most_scores, &known[n]) == FOUND)
            n++;
    }
    double least = with_runner_up ? highest_apart(bank, known, n, best->cell) : best->score;
    for (;;) {
        /* Where both cells that lag 0 told of are in the best one's peak, a lag that is left out may have the runner-up. */
        if (least < left_out_below || !collect(hunt, least)
            || settle(hunt, -1, best->score, most_scores, best) != FOUND)
            return UNDECIDED;
        if (!with_runner_up)
            return FOUND;
        double reached = highest_apart(bank, known, n, best->cell);
        if (reached >= least)
            return settle(hunt, best->cell, reached, most_scores, other);
        /* It is another one than was known, with the known runner-up in its peak: once more, from further down. The best
           is the same then, and so is what is known beside it, which ends it. */
        least = reached;
    }
}

static PyObject *match_at_all_lags(PyObject *self, PyObject *args)
{
    const Bank *bank = bank_of(self);
    Hunt hunt;
    Py_buffer difference, parts;
    PyObject *correlate;
    int with_runner_up, first, end;
    long most_scores;
    Found known[4], best, other = {-1, 0};
    if (!bank || !PyArg_ParseTuple(args, "y*Opl", &difference, &correlate, &with_runner_up, &most_scores))
        return NULL;
    int sound = difference.len == CHANNELS * sizeof(double) && take_frame(&hunt, bank, difference.buf);
    PyBuffer_Release(&difference);
    if (!sound || find_at_lag_0(&hunt, -1, most_scores, &known[0]) != FOUND)
        Py_RETURN_NONE;
    if (with_runner_up && find_at_lag_0(&hunt, known[0].cell, most_scores, &known[1]) != FOUND)
        Py_RETURN_NONE;
    if (!lags_that_may_reach(&hunt, known[with_runner_up].score, &first, &end))
        Py_RETURN_NONE;
    int few = end - first <= FEW_LAGS;
    if (!few && !correlated(correlate, &hunt, first, end, &parts))
        return NULL;
    Outcome outcome = find_at_all_lags(&hunt, few ? NULL : parts.buf, first, end, with_runner_up, most_scores, known,
                                       &best, &other);
    if (!few)
        PyBuffer_Release(&parts);
    if (outcome != FOUND)
        Py_RETURN_NONE;
    return as_tuple(&best, &other);
}

PyDoc_STRVAR(match_at_all_lags_doc,
"match_at_all_lags(difference, correlate, runner_up, most_scores) -> (cell, score, cell, score) | None\n\n"
"Search at all lags; as `match`, and None also where there are many bounds to compute, which numpy does quicker.\n"
"correlate(frame, first, end) returns the (rank, end - first) float32 products of the basis and the frame, (896,) float32\n"
"in bytes, at the lags from `first` up to before `end`.");

/* Σ (difference / noise)², or −1 where a value is not finite or a noise not above zero. */
static PyObject *energy(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer difference, noise;
    if (!PyArg_ParseTuple(args, "y*y*", &difference, &noise))
        return NULL;
    double sum = -1.0;
    if (difference.len == noise.len) {
        const double *value = difference.buf, *deviation = noise.buf;
        Py_ssize_t n = difference.len / (Py_ssize_t)sizeof(double);
        sum = 0.0;
        for (Py_ssize_t i = 0; i < n; i++) {
            if (!(isfinite(value[i]) && isfinite(deviation[i]) && deviation[i] > 0)) {
                sum = -1.0;
                break;
            }
            double ratio = value[i] / deviation[i];
            sum += ratio * ratio;
        }
    }
    PyBuffer_Release(&difference);
    PyBuffer_Release(&noise);
    return PyFloat_FromDouble(sum);
}

PyDoc_STRVAR(energy_doc,
"energy(difference, noise) -> float\n\n"
"Return the sum of the squares of difference / noise, both float64; -1 where one of them is not sound.");

/* The buffer of an array of `n` items of `size` bytes, which is held as long as the search lives; NULL with an error. */
static const void *hold(Search *s, PyObject *array, Py_ssize_t n, size_t size)
{
    if (s->n_held == MOST_BUFFERS) {
        PyErr_SetString(PyExc_ValueError, "more arrays than a search holds");
        return NULL;
    }
    Py_buffer *held = &s->held[s->n_held];
    if (PyObject_GetBuffer(array, held, PyBUF_C_CONTIGUOUS) < 0)
        return NULL;
    s->n_held++;
    if (held->itemsize != (Py_ssize_t)size || (n >= 0 && held->len != n * (Py_ssize_t)size)) {
        PyErr_Format(PyExc_ValueError, "an array of %zd bytes where %zd items of %zu bytes belong", held->len, n, size);
        return NULL;
    }
    return held->buf;
}

static int all_within(const int32_t *numbers, Py_ssize_t n, Py_ssize_t end)
{
    for (Py_ssize_t i = 0; i < n; i++)
        if (numbers[i] < 0 || numbers[i] >= end)
            return 0;
    return 1;
}

static int are_starts(const int32_t *starts, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        if (starts[i] > starts[i + 1])
            return 0;
    return starts[0] == 0;
}

static int hold_levels(Search *s, PyObject *levels)
{
    Py_ssize_t n = PyTuple_Size(levels), n_parts = 0;
    if (n < 1 || n > MOST_LEVELS) {
        if (!PyErr_Occurred())
            PyErr_SetString(PyExc_ValueError, "a search has one level of groups to eight");
        return -1;
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        PyObject *rows, *starts;
        Level *level = &s->bank.levels[i];
        if (!PyArg_ParseTuple(PyTuple_GetItem(levels, i), "OO", &rows, &starts)
            || !(level->starts = hold(s, starts, -1, sizeof(int32_t))))
            return -1;
        level->n = s->held[s->n_held - 1].len / (Py_ssize_t)sizeof(int32_t) - 1;
        if (level->n < 1 || (i > 0 && level->n != n_parts)) {
            PyErr_SetString(PyExc_ValueError, "the groups of a level are not the parts of the level before");
            return -1;
        }
        if (!(level->rows = hold(s, rows, level->n * (s->bank.coarse_rank + 2), sizeof(float))))
            return -1;
        n_parts = level->starts[level->n];
        if (!are_starts(level->starts, level->n)) {
            PyErr_SetString(PyExc_ValueError, "the parts of a level's groups are not sound");
            return -1;
        }
    }
    s->bank.n_levels = (int)n;
    if (n_parts != s->bank.n_cells) {
        PyErr_SetString(PyExc_ValueError, "the parts of the last level are not the cells");
        return -1;
    }
    return 0;
}

/* Hold the arrays of a bank, in the order of the arguments of `Search`. */
static int hold_bank(Search *s, PyObject *const *arrays, PyObject *levels)
{
    Bank *bank = &s->bank;
    if (!(bank->norms = hold(s, arrays[5], -1, sizeof(double))))
        return -1;
    bank->n_cells = s->held[0].len / (Py_ssize_t)sizeof(double);
    if (!bank->n_cells || bank->n_cells > INT32_MAX) {
        PyErr_SetString(PyExc_ValueError, "a bank without cells, or of more than can be numbered");
        return -1;
    }
    if (!(bank->basis = hold(s, arrays[0], -1, sizeof(float)))
        || !(bank->coarse = hold(s, arrays[1], -1, sizeof(float))))
        return -1;
    bank->fine_rank = s->held[1].len / (CHANNELS * (Py_ssize_t)sizeof(float));
    bank->coarse_rank = s->held[2].len / (bank->n_cells * (Py_ssize_t)sizeof(float)) - 2;
    if (bank->coarse_rank < 1 || bank->fine_rank < bank->coarse_rank || bank->fine_rank > MOST_RANK
        || s->held[2].len != bank->n_cells * (bank->coarse_rank + 2) * (Py_ssize_t)sizeof(float)) {
        PyErr_SetString(PyExc_ValueError, "the bank's ranks are not sound");
        return -1;
    }
    if (!(bank->fine = hold(s, arrays[2], bank->n_cells * (bank->fine_rank + 2), sizeof(float)))
        || !(bank->places = hold(s, arrays[4], bank->n_cells, sizeof(int64_t)))
        || !(bank->k_of = hold(s, arrays[6], bank->n_cells, sizeof(int32_t)))
        || !(bank->sigma_of = hold(s, arrays[7], bank->n_cells, sizeof(int32_t)))
        || !(bank->overlaps = hold(s, arrays[8], 2 * CHANNELS, sizeof(double)))
        || !(bank->cells = hold(s, arrays[9], bank->n_cells, sizeof(int32_t)))
        || !(bank->signals = hold(s, arrays[3], -1, sizeof(float))))
        return -1;
    Py_ssize_t n_signals = s->held[s->n_held - 1].len / (CHANNELS * (Py_ssize_t)sizeof(float));
    for (Py_ssize_t i = 0; i < bank->n_cells; i++) {
        if (bank->places[i] < 0 || bank->places[i] >= n_signals) {
            PyErr_SetString(PyExc_ValueError, "a cell's place is not in the signals");
            return -1;
        }
    }
    if (!all_within(bank->cells, bank->n_cells, bank->n_cells)) {
        PyErr_SetString(PyExc_ValueError, "the cells of the groups are not the bank's");
        return -1;
    }
    return hold_levels(s, levels);
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
    PyObject *arrays[10], *levels, *multiply;
    if (s->n_held || (named && PyDict_Size(named))) {
        PyErr_SetString(PyExc_TypeError, "a search is made once, and its arguments have no names");
        return -1;
    }
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOO!Oddddl", &arrays[0], &arrays[1], &arrays[2], &arrays[3], &arrays[4],
                          &arrays[5], &arrays[6], &arrays[7], &arrays[8], &arrays[9], &PyTuple_Type, &levels,
                          &multiply, &bank->rounding, &bank->square_rounding, &bank->tie, &bank->tie_rounding, &bank->radius))
        return -1;
    if (!names_sgemm(multiply)) {
        PyErr_SetString(PyExc_TypeError, "this is no sgemm of scipy's");
        return -1;
    }
    if (!(bank->multiply = (Multiply *)PyCapsule_GetPointer(multiply, PyCapsule_GetName(multiply))))
        return -1;
    if (hold_bank(s, arrays, levels) < 0)
        return -1;
    bank->most_candidates = bank->n_cells > LEAST_CANDIDATES ? bank->n_cells : LEAST_CANDIDATES;
    bank->candidates = PyMem_Malloc((size_t)bank->most_candidates * sizeof(Candidate));
    bank->roots = PyMem_Malloc((size_t)bank->levels[0].n * sizeof(Root));
    bank->bounds = PyMem_Malloc((size_t)bank->levels[0].n * 2 * CHANNELS * sizeof(float));
    bank->columns = PyMem_Malloc(2 * CHANNELS * (size_t)(bank->coarse_rank + 2) * sizeof(float));
    bank->lags = PyMem_Malloc(2 * CHANNELS * sizeof(int));
    if (!bank->candidates || !bank->roots || !bank->bounds || !bank->columns || !bank->lags) {
        PyErr_NoMemory();
        return -1;
    }
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
    PyMem_Free(s->bank.roots);
    PyMem_Free(s->bank.bounds);
    PyMem_Free(s->bank.columns);
    PyMem_Free(s->bank.lags);
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
    {Py_tp_doc, "A compressed bank that is searched; see bank/compiled.py."},
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
    .m_doc = "What bank.fast_matching does with many calls of numpy, in one.",
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
