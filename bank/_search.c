/* The search at lag 0 of bank/fast_matching.py, compiled: the same bounds, the same scores, in one call.

   A frame comes after half a second in which others had the processor's caches, and then each call of numpy costs some
   ten microseconds whatever it computes. Here the groups of the compressed bank (bank/compression.py) are gone through
   from few to many, and only what may reach the highest score so far is looked at: little code and little memory.

   The arrays that are handed in have been made by bank/compiled.py, which says what they are; their lengths are checked,
   their types are not. Everything runs with the interpreter's lock held, so that a search may use the object's own
   memory. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define CHANNELS 896
#define LANES 8
#define MOST_LEVELS 8
#define MOST_BUFFERS (10 + 3 * MOST_LEVELS)
#define MOST_RANK 128

/* With fewer candidates, scoring them costs less than to bound them anew. */
#define FEW_CANDIDATES 16

typedef struct {
    const float *rows;       /* (n, coarse_rank + 2): bounds of the groups */
    const int32_t *starts;   /* (n + 1,): where the parts of each group begin in `parts` */
    const int32_t *parts;    /* groups of the next level; after the last one, cells */
    Py_ssize_t n;
} Level;

typedef struct {
    float bound;
    int32_t cell;
    double score;            /* below 0 until it is known */
} Candidate;

typedef struct {
    float estimate;
    float bound;
    int32_t group;
} Root;

typedef struct {
    PyObject_HEAD
    Py_buffer held[MOST_BUFFERS];
    int n_held;
    Py_ssize_t coarse_rank, fine_rank, n_cells;
    const float *basis;      /* (fine_rank, 896) */
    const float *coarse;     /* (n_cells, coarse_rank + 2) */
    const float *fine;       /* (n_cells, fine_rank + 2) */
    const float *signals;    /* (any, 896) */
    const int64_t *places;   /* (n_cells,): the row of each cell in `signals` */
    const double *norms;     /* (n_cells,) */
    const int32_t *k_of, *sigma_of; /* (n_cells,): the place of each cell in the grid */
    Level levels[MOST_LEVELS];
    int n_levels;
    double rounding, square_rounding, tie, tie_rounding;
    long radius;
    Candidate *candidates;   /* (n_cells,) */
    Root *roots;             /* (levels[0].n,) */
} Search;

/* A frame that is being searched for, and what has been found of it. */
typedef struct {
    Search *search;
    double frame[CHANNELS];
    float single[CHANNELS];
    float parts[MOST_RANK];
    float column[MOST_RANK + 2], fine_column[MOST_RANK + 2];
    int has_fine;
    /* Of one of the two searches, for the best cell and for the runner-up. */
    long scores_left;        /* so many cells may still be scored */
    int32_t apart_from;      /* only cells outside the peak of this one count; -1: all */
    double reached;          /* the highest score so far */
    float highest;           /* the highest bound so far */
    Py_ssize_t n_candidates;
} Pass;

static float product(const float *a, const float *b, Py_ssize_t n)
{
    float lanes[LANES] = {0};
    float sum = 0;
    Py_ssize_t whole = n - n % LANES;
    for (Py_ssize_t i = 0; i < whole; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += a[i + lane] * b[i + lane];
    for (Py_ssize_t i = whole; i < n; i++)
        sum += a[i] * b[i];
    for (int lane = 0; lane < LANES; lane++)
        sum += lanes[lane];
    return sum;
}

static double score_of(Pass *pass, int32_t cell)
{
    const Search *s = pass->search;
    const float *signal = s->signals + s->places[cell] * CHANNELS;
    double lanes[LANES] = {0};
    double sum = 0;
    for (int i = 0; i < CHANNELS; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += pass->frame[i + lane] * fabs((double)signal[i + lane]);
    for (int lane = 0; lane < LANES; lane++)
        sum += lanes[lane];
    pass->scores_left--;
    return sum / s->norms[cell];
}

static void reach(Pass *pass, Candidate *candidate)
{
    candidate->score = score_of(pass, candidate->cell);
    if (candidate->score > pass->reached)
        pass->reached = candidate->score;
}

static int may_reach(const Pass *pass, float bound)
{
    return (double)bound >= pass->reached - pass->search->rounding;
}

static int in_its_peak(const Pass *pass, int32_t cell)
{
    const Search *s = pass->search;
    if (pass->apart_from < 0)
        return 0;
    return labs((long)s->k_of[cell] - s->k_of[pass->apart_from]) <= s->radius
        && labs((long)s->sigma_of[cell] - s->sigma_of[pass->apart_from]) <= s->radius;
}

/* The column of bank/compression.py: the frame's first `rank` numbers, the norm of all of these but the first, and what
   is left of the frame. */
static void make_column(const Pass *pass, Py_ssize_t rank, float *column)
{
    const float *parts = pass->parts;
    double across = 0;
    for (Py_ssize_t i = 1; i < rank; i++)
        across += (double)parts[i] * parts[i];
    double left = 1.0 - (double)parts[0] * parts[0] - across;
    memcpy(column, parts, (size_t)rank * sizeof(float));
    column[rank] = (float)sqrt(across);
    column[rank + 1] = (float)sqrt((left > 0 ? left : 0) + pass->search->square_rounding);
}

static void project(Pass *pass, Py_ssize_t from, Py_ssize_t to)
{
    for (Py_ssize_t i = from; i < to; i++)
        pass->parts[i] = product(pass->search->basis + i * CHANNELS, pass->single, CHANNELS);
}

/* Take the magnitudes of a difference, scaled to the norm 1; 0 where they have none. */
static int take_frame(Pass *pass, const double *difference)
{
    double largest = 0, sum = 0;
    for (int i = 0; i < CHANNELS; i++) {
        pass->frame[i] = fabs(difference[i]);
        /* Not fmax, which would pass over what is not a number. */
        if (!(pass->frame[i] <= largest))
            largest = pass->frame[i];
    }
    if (!(largest > 0 && largest < INFINITY))
        return 0;
    for (int i = 0; i < CHANNELS; i++) {
        pass->frame[i] /= largest;
        sum += pass->frame[i] * pass->frame[i];
    }
    double norm = sqrt(sum);
    if (!(norm > 0 && norm < INFINITY))
        return 0;
    for (int i = 0; i < CHANNELS; i++) {
        pass->frame[i] /= norm;
        pass->single[i] = (float)pass->frame[i];
    }
    project(pass, 0, pass->search->coarse_rank);
    make_column(pass, pass->search->coarse_rank, pass->column);
    return 1;
}

static void look_at_cell(Pass *pass, int32_t cell)
{
    const Search *s = pass->search;
    float bound = product(s->coarse + cell * (s->coarse_rank + 2), pass->column, s->coarse_rank + 2);
    if (!may_reach(pass, bound) || in_its_peak(pass, cell))
        return;
    Candidate *found = &s->candidates[pass->n_candidates++];
    *found = (Candidate){bound, cell, -1.0};
    if (bound > pass->highest) {
        /* The higher the score that is known, the more can be left out. */
        pass->highest = bound;
        reach(pass, found);
    }
}

static void look_into(Pass *pass, int level, int32_t group)
{
    const Search *s = pass->search;
    const Level *here = &s->levels[level];
    for (int32_t i = here->starts[group]; i < here->starts[group + 1]; i++) {
        int32_t part = here->parts[i];
        if (level + 1 == s->n_levels) {
            look_at_cell(pass, part);
            continue;
        }
        const float *row = s->levels[level + 1].rows + part * (s->coarse_rank + 2);
        if (may_reach(pass, product(row, pass->column, s->coarse_rank + 2)))
            look_into(pass, level + 1, part);
    }
}

static int by_estimate(const void *one, const void *other)
{
    float a = ((const Root *)one)->estimate, b = ((const Root *)other)->estimate;
    return (a < b) - (a > b);
}

static int by_bound(const void *one, const void *other)
{
    float a = ((const Candidate *)one)->bound, b = ((const Candidate *)other)->bound;
    return (a < b) - (a > b);
}

static void bound_roots(Pass *pass)
{
    const Search *s = pass->search;
    Py_ssize_t rank = s->coarse_rank;
    for (Py_ssize_t group = 0; group < s->levels[0].n; group++) {
        const float *row = s->levels[0].rows + group * (rank + 2);
        float estimate = product(row, pass->column, rank);
        float bound = estimate + row[rank] * pass->column[rank] + row[rank + 1] * pass->column[rank + 1];
        s->roots[group] = (Root){estimate, bound, (int32_t)group};
    }
    qsort(s->roots, (size_t)s->levels[0].n, sizeof(Root), by_estimate);
}

static Py_ssize_t keep_what_may_reach(Pass *pass)
{
    Candidate *all = pass->search->candidates;
    Py_ssize_t kept = 0;
    for (Py_ssize_t i = 0; i < pass->n_candidates; i++)
        if (may_reach(pass, all[i].bound))
            all[kept++] = all[i];
    return pass->n_candidates = kept;
}

static void bound_anew(Pass *pass)
{
    const Search *s = pass->search;
    if (!pass->has_fine) {
        project(pass, s->coarse_rank, s->fine_rank);
        make_column(pass, s->fine_rank, pass->fine_column);
        pass->has_fine = 1;
    }
    for (Py_ssize_t i = 0; i < pass->n_candidates; i++) {
        Candidate *each = &s->candidates[i];
        each->bound = product(s->fine + each->cell * (s->fine_rank + 2), pass->fine_column, s->fine_rank + 2);
    }
}

typedef enum { NONE, FOUND, UNDECIDED } Outcome;

/* Find the cell of the highest score, the first of those that tie, among those that are not in the peak of
   `apart_from`. UNDECIDED: it hangs on rounding which cells tie, or too many would have to be scored. */
static Outcome find(Pass *pass, int32_t apart_from, long most_scores, int32_t *cell, double *score)
{
    const Search *s = pass->search;
    pass->apart_from = apart_from;
    pass->scores_left = most_scores;
    pass->reached = 0.0;
    pass->highest = -1.0f;
    pass->n_candidates = 0;
    for (Py_ssize_t i = 0; i < s->levels[0].n; i++)
        if (may_reach(pass, s->roots[i].bound))
            look_into(pass, 0, s->roots[i].group);
    if (keep_what_may_reach(pass) > FEW_CANDIDATES) {
        bound_anew(pass);
        qsort(s->candidates, (size_t)pass->n_candidates, sizeof(Candidate), by_bound);
    }
    for (Py_ssize_t i = 0; i < pass->n_candidates; i++) {
        if (s->candidates[i].score >= 0 || !may_reach(pass, s->candidates[i].bound))
            continue;
        if (pass->scores_left <= 0)
            return UNDECIDED;
        reach(pass, &s->candidates[i]);
    }
    *cell = -1;
    for (Py_ssize_t i = 0; i < pass->n_candidates; i++) {
        const Candidate *each = &s->candidates[i];
        double behind = pass->reached - each->score;
        if (each->score < 0)
            continue;
        if (fabs(behind - s->tie) < s->tie_rounding)
            return UNDECIDED;
        if (behind <= s->tie && (*cell < 0 || each->cell < *cell)) {
            *cell = each->cell;
            *score = each->score < 1.0 ? each->score : 1.0;
        }
    }
    return *cell < 0 ? NONE : FOUND;
}

static PyObject *search_match(PyObject *self, PyObject *args)
{
    Search *s = (Search *)self;
    Py_buffer difference;
    int with_runner_up;
    long most_scores;
    Pass pass;
    if (!PyArg_ParseTuple(args, "y*pl", &difference, &with_runner_up, &most_scores))
        return NULL;
    int sound = difference.len == CHANNELS * sizeof(double);
    pass.search = s;
    pass.has_fine = 0;
    sound = sound && take_frame(&pass, difference.buf);
    PyBuffer_Release(&difference);
    int32_t best = -1, other = -1;
    double score = 0, other_score = 0;
    if (sound) {
        bound_roots(&pass);
        sound = find(&pass, -1, most_scores, &best, &score) == FOUND;
        if (sound && with_runner_up)
            sound = find(&pass, best, most_scores, &other, &other_score) != UNDECIDED;
    }
    if (!sound)
        Py_RETURN_NONE;
    return Py_BuildValue("ldld", (long)best, score, (long)other, other_score);
}

PyDoc_STRVAR(match_doc,
"match(difference, runner_up, most_scores) -> (cell, score, cell, score) | None\n\n"
"Search for a (896,) float64 difference: the best cell and the best one outside its peak, -1 where there is none.\n"
"None: the difference has no magnitude, a tie hangs on rounding, or more cells than that have to be scored for one of them.");

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
        PyObject *rows, *starts, *parts;
        Level *level = &s->levels[i];
        if (!PyArg_ParseTuple(PyTuple_GetItem(levels, i), "nOOO", &level->n, &rows, &starts, &parts))
            return -1;
        if (i > 0 && level->n != n_parts) {
            PyErr_SetString(PyExc_ValueError, "the groups of a level are not the parts of the level before");
            return -1;
        }
        level->rows = hold(s, rows, level->n * (s->coarse_rank + 2), sizeof(float));
        level->starts = level->rows ? hold(s, starts, level->n + 1, sizeof(int32_t)) : NULL;
        if (!level->starts)
            return -1;
        n_parts = level->starts[level->n];
        if (!are_starts(level->starts, level->n) || !(level->parts = hold(s, parts, n_parts, sizeof(int32_t)))
            || !all_within(level->parts, n_parts, n_parts)) {
            if (!PyErr_Occurred())
                PyErr_SetString(PyExc_ValueError, "the parts of a level's groups are not sound");
            return -1;
        }
    }
    s->n_levels = (int)n;
    if (n_parts != s->n_cells) {
        PyErr_SetString(PyExc_ValueError, "the parts of the last level are not the cells");
        return -1;
    }
    return 0;
}

static int search_init(PyObject *self, PyObject *args, PyObject *named)
{
    static char *names[] = {"basis", "coarse", "fine", "signals", "places", "norms", "k_of", "sigma_of", "levels",
                            "rounding", "square_rounding", "tie", "tie_rounding", "radius", NULL};
    Search *s = (Search *)self;
    PyObject *basis, *coarse, *fine, *signals, *places, *norms, *k_of, *sigma_of, *levels;
    if (!PyArg_ParseTupleAndKeywords(args, named, "OOOOOOOOO!ddddl", names, &basis, &coarse, &fine, &signals, &places,
                                     &norms, &k_of, &sigma_of, &PyTuple_Type, &levels, &s->rounding,
                                     &s->square_rounding, &s->tie, &s->tie_rounding, &s->radius))
        return -1;
    if (s->n_held) {
        PyErr_SetString(PyExc_ValueError, "a search is made once");
        return -1;
    }
    if (!(s->norms = hold(s, norms, -1, sizeof(double))) || !(s->basis = hold(s, basis, -1, sizeof(float))))
        return -1;
    s->n_cells = s->held[0].len / (Py_ssize_t)sizeof(double);
    s->fine_rank = s->held[1].len / (CHANNELS * (Py_ssize_t)sizeof(float));
    if (!(s->coarse = hold(s, coarse, -1, sizeof(float))))
        return -1;
    s->coarse_rank = s->n_cells ? s->held[2].len / (s->n_cells * (Py_ssize_t)sizeof(float)) - 2 : 0;
    if (s->coarse_rank < 1 || s->fine_rank < s->coarse_rank || s->fine_rank > MOST_RANK) {
        PyErr_SetString(PyExc_ValueError, "the bank's ranks are not sound");
        return -1;
    }
    if (!(s->fine = hold(s, fine, s->n_cells * (s->fine_rank + 2), sizeof(float)))
        || !(s->signals = hold(s, signals, -1, sizeof(float)))
        || !(s->places = hold(s, places, s->n_cells, sizeof(int64_t)))
        || !(s->k_of = hold(s, k_of, s->n_cells, sizeof(int32_t)))
        || !(s->sigma_of = hold(s, sigma_of, s->n_cells, sizeof(int32_t)))
        || hold_levels(s, levels) < 0)
        return -1;
    const Py_buffer *read = &s->held[4];
    for (Py_ssize_t i = 0; i < s->n_cells; i++) {
        if (s->places[i] < 0 || s->places[i] >= read->len / (CHANNELS * (Py_ssize_t)sizeof(float))) {
            PyErr_SetString(PyExc_ValueError, "a cell's place is not in the signals");
            return -1;
        }
    }
    s->candidates = PyMem_Malloc((size_t)s->n_cells * sizeof(Candidate));
    s->roots = PyMem_Malloc((size_t)s->levels[0].n * sizeof(Root));
    if (!s->candidates || !s->roots) {
        PyErr_NoMemory();
        return -1;
    }
    return 0;
}

static void search_dealloc(PyObject *self)
{
    Search *s = (Search *)self;
    PyTypeObject *type = Py_TYPE(self);
    while (s->n_held)
        PyBuffer_Release(&s->held[--s->n_held]);
    PyMem_Free(s->candidates);
    PyMem_Free(s->roots);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef search_methods[] = {
    {"match", search_match, METH_VARARGS, match_doc},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot search_slots[] = {
    {Py_tp_doc, "A compressed bank, searched at lag 0; see bank/compiled.py."},
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
    if (!type || PyModule_AddObjectRef(found, "Search", type) < 0) {
        Py_XDECREF(found);
        found = NULL;
    }
    Py_XDECREF(type);
    return found;
}
