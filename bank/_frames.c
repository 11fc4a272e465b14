/* bank/look.c and bank/medians.c for Python: what estimators that know their fingertip ask of each frame.

   The arrays that are handed in come of bank/compiled.py; their sizes are checked, for they decide where is read. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "look.h"

#include <string.h>

enum { ROW_BYTES = MOST_VALUES * sizeof(double), MOST = 1024 };

typedef struct {
    PyObject_HEAD
    Py_ssize_t n_sides;
    Fingertip *tips;
    double *values; /* what they point to */
    int is_whole;   /* all of it is there */
    Limits limits;
    double small_v;
} Fingertips;

/* Put an item, NULL where none could be made, into a list, which is given up where that fails. */
static void put(PyObject **list, Py_ssize_t i, PyObject *item)
{
    if (!item || PyList_SetItem(*list, i, item) < 0)
        Py_CLEAR(*list);
}

static PyObject *medians_of(const double *rows, const int64_t *counts, Py_ssize_t n)
{
    PyObject *found = PyList_New(n);
    for (Py_ssize_t i = 0; found && i < n; i++)
        put(&found, i, PyFloat_FromDouble(median_of(rows + i * MOST_VALUES, counts[i])));
    return found;
}

static PyObject *medians(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer rows, counts;
    if (!PyArg_ParseTuple(args, "y*y*", &rows, &counts))
        return NULL;
    PyObject *found = NULL;
    Py_ssize_t n = counts.len / (Py_ssize_t)sizeof(int64_t);
    if (rows.len == n * MOST_VALUES * (Py_ssize_t)sizeof(double))
        found = medians_of(rows.buf, counts.buf, n);
    else
        PyErr_Format(PyExc_ValueError, "%zd counts for rows of %zd bytes", n, rows.len);
    PyBuffer_Release(&rows);
    PyBuffer_Release(&counts);
    return found;
}

PyDoc_STRVAR(medians_doc,
"medians(rows, counts) -> list of float\n\n"
"Return the median of each of (n, 896) float64 rows, in order with NaN last, of its first counts (n,) int64 values.");

static PyObject *off_from_each(const double *known, const double *frame, const int64_t *counts, Py_ssize_t n,
                               Py_ssize_t n_each, double *off)
{
    PyObject *found = PyList_New(n);
    for (Py_ssize_t i = 0; found && i < n; i++) {
        const double *row = frame + i / n_each * MOST_VALUES;
        Py_ssize_t at = i * MOST_VALUES;
        compare(known + at, row, counts[i], off + at);
        put(&found, i, PyFloat_FromDouble(median_of(off + at, counts[i])));
    }
    return found;
}

static PyObject *compared(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer known, frame, counts, off;
    if (!PyArg_ParseTuple(args, "y*y*y*w*", &known, &frame, &counts, &off))
        return NULL;
    PyObject *found = NULL;
    Py_ssize_t row_bytes = MOST_VALUES * (Py_ssize_t)sizeof(double);
    Py_ssize_t n = counts.len / (Py_ssize_t)sizeof(int64_t), n_rows = frame.len / row_bytes;
    if (n_rows > 0 && frame.len == n_rows * row_bytes && n % n_rows == 0 && known.len == n * row_bytes
        && off.len == known.len)
        found = off_from_each(known.buf, frame.buf, counts.buf, n, n / n_rows, off.buf);
    else
        PyErr_Format(PyExc_ValueError, "a frame of %zd bytes is not compared with %zd of %zd", frame.len, n, known.len);
    PyBuffer_Release(&known);
    PyBuffer_Release(&frame);
    PyBuffer_Release(&counts);
    PyBuffer_Release(&off);
    return found;
}

PyDoc_STRVAR(compared_doc,
"compared(known, frame, counts, off) -> list of float\n\n"
"Write by which shares a (m, 896) frame is off from each of (m, k, 896) known ones into `off`, all float64, and return the\n"
"medians: of each known row so many values count as counts (m·k) int64 say, the others are NaN.");

static PyObject *n_largest(PyObject *module, PyObject *array)
{
    (void)module;
    Py_buffer rows;
    if (PyObject_GetBuffer(array, &rows, PyBUF_C_CONTIGUOUS) < 0)
        return NULL;
    Py_ssize_t row_bytes = MOST_VALUES * (Py_ssize_t)sizeof(double), n = rows.len / row_bytes;
    PyObject *found = NULL;
    if (rows.len == n * row_bytes)
        found = PyList_New(n);
    else
        PyErr_Format(PyExc_ValueError, "%zd bytes are no rows of 896 values", rows.len);
    for (Py_ssize_t i = 0; found && i < n; i++)
        put(&found, i, PyLong_FromLong(n_largest_of((const double *)rows.buf + i * MOST_VALUES)));
    PyBuffer_Release(&rows);
    return found;
}

PyDoc_STRVAR(n_largest_doc,
"n_largest(rows) -> list of int\n\n"
"Return how many of each of (n, 896) float64 rows are its largest.");

/* Arrays that are looked at, until they are given back. */
typedef struct {
    Py_buffer buffers[6];
    int n;
} Taken;

/* The bytes of one more array; NULL for one of another size or format (below 0, NULL: whatever it is), or in pieces. */
static void *take(Taken *taken, PyObject *array, const char *format, Py_ssize_t n_bytes, int flags)
{
    Py_buffer *buffer = &taken->buffers[taken->n];
    if (PyObject_GetBuffer(array, buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags) < 0) {
        PyErr_Clear();
        return NULL;
    }
    taken->n++;
    return (n_bytes < 0 || buffer->len == n_bytes) && (!format || strcmp(buffer->format, format) == 0) ? buffer->buf : NULL;
}

static void give_back(Taken *taken)
{
    while (taken->n)
        PyBuffer_Release(&taken->buffers[--taken->n]);
}

static Fingertips *fingertips_of(PyObject *self)
{
    if (((Fingertips *)self)->is_whole)
        return (Fingertips *)self;
    PyErr_SetString(PyExc_ValueError, "these are no fingertips");
    return NULL;
}

static int are_ordinary(const Fingertips *f, const double *frame)
{
    for (Py_ssize_t i = 0; i < f->n_sides; i++)
        if (!is_ordinary(f->tips + i, &f->limits, frame + i * MOST_VALUES))
            return 0;
    return 1;
}

static PyObject *jumping(const Fingertips *f, const double *frame, const double *before)
{
    PyObject *found = PyList_New(f->n_sides);
    for (Py_ssize_t i = 0; found && i < f->n_sides; i++) {
        Py_ssize_t at = i * MOST_VALUES;
        put(&found, i, PyLong_FromLong(n_jumping(f->tips + i, frame + at, before + at)));
    }
    return found;
}

static PyObject *check(PyObject *self, PyObject *args)
{
    const Fingertips *f = fingertips_of(self);
    PyObject *arrays[3], *found;
    if (!f || !PyArg_ParseTuple(args, "OOO", &arrays[0], &arrays[1], &arrays[2]))
        return NULL;
    Taken taken = {.n = 0};
    const double *frame = take(&taken, arrays[0], "d", f->n_sides * ROW_BYTES, 0);
    const char *usable = take(&taken, arrays[1], "?", f->n_sides * MOST_VALUES, 0);
    const double *before = take(&taken, arrays[2], "d", f->n_sides * ROW_BYTES, 0);
    if (frame && usable && before && !memchr(usable, 0, (size_t)f->n_sides * MOST_VALUES) && are_ordinary(f, frame))
        found = jumping(f, frame, before);
    else
        found = Py_NewRef(Py_None);
    give_back(&taken);
    return found;
}

PyDoc_STRVAR(check_doc,
"check(frame, usable, before) -> list of int | None\n\n"
"Return how many channels of each side jump since the frame before; all (m, 896). None of a frame that is not ordinary.");

static PyObject *all_placed(const Fingertips *f, const double *frame, const double *idle, const double *gains,
                            double *difference, double *places)
{
    PyObject *found = PyList_New(f->n_sides);
    for (Py_ssize_t i = 0; found && i < f->n_sides; i++) {
        Py_ssize_t at = i * MOST_VALUES;
        const Fingertip *tip = f->tips + i;
        double *its_places = places + i * tip->n_directions;
        put(&found, i, PyFloat_FromDouble(place(tip, f->small_v, frame + at, idle + at, gains[i], difference + at,
                                                its_places, its_places + f->n_sides * tip->n_directions)));
    }
    return found;
}

static PyObject *placed(PyObject *self, PyObject *args)
{
    const Fingertips *f = fingertips_of(self);
    PyObject *arrays[6], *found;
    if (!f || !PyArg_ParseTuple(args, "OOOOOO", &arrays[0], &arrays[1], &arrays[2], &arrays[3], &arrays[4], &arrays[5]))
        return NULL;
    Taken taken = {.n = 0};
    Py_ssize_t n_bytes = f->n_sides * ROW_BYTES, n_places = 2 * f->n_sides * f->tips->n_directions;
    const double *frame = take(&taken, arrays[0], "d", n_bytes, 0);
    const char *usable = take(&taken, arrays[1], "?", f->n_sides * MOST_VALUES, 0);
    const double *idle = take(&taken, arrays[2], "d", n_bytes, 0);
    const double *gains = take(&taken, arrays[3], "d", f->n_sides * (Py_ssize_t)sizeof(double), 0);
    double *difference = take(&taken, arrays[4], "d", n_bytes, PyBUF_WRITABLE);
    double *places = take(&taken, arrays[5], "d", n_places * (Py_ssize_t)sizeof(double), PyBUF_WRITABLE);
    if (frame && usable && idle && gains && difference && places && !memchr(usable, 0, (size_t)f->n_sides * MOST_VALUES))
        found = all_placed(f, frame, idle, gains, difference, places);
    else
        found = Py_NewRef(Py_None);
    give_back(&taken);
    return found;
}

PyDoc_STRVAR(placed_doc,
"placed(frame, usable, idle, gains, difference, places) -> list of float | None\n\n"
"Return the score of each side's grip, and write the (m, 896) difference to the idle frame at the calibration's gain, and\n"
"where the frame at that gain, and the difference, lie along the directions, (2, m, p). None where not all is usable.");

/* Take arrays of as many values as the first, the first to be written to or not; their number, −1 where they are not. */
static Py_ssize_t take_alike(Taken *taken, PyObject *const *arrays, double **values, int n_arrays, int first_flags)
{
    Py_ssize_t n_bytes = -1;
    for (int i = 0; i < n_arrays; i++) {
        if (!(values[i] = take(taken, arrays[i], "d", n_bytes, i ? 0 : first_flags)))
            return -1;
        n_bytes = taken->buffers[0].len;
    }
    return n_bytes / (Py_ssize_t)sizeof(double);
}

static PyObject *all_finite(PyObject *module, PyObject *array)
{
    (void)module;
    Taken taken = {.n = 0};
    double *values;
    Py_ssize_t n = take_alike(&taken, &array, &values, 1, 0);
    PyObject *found = n < 0 ? Py_NewRef(Py_None) : PyBool_FromLong(are_finite(values, n));
    give_back(&taken);
    return found;
}

PyDoc_STRVAR(all_finite_doc,
"all_finite(values) -> bool | None\n\n"
"Return whether all of an array are finite; None of one that is not float64, or in pieces, as the others here.");

static PyObject *deviation(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *arrays[3];
    Taken taken = {.n = 0};
    double *values[3];
    if (!PyArg_ParseTuple(args, "OOO", &arrays[0], &arrays[1], &arrays[2]))
        return NULL;
    Py_ssize_t n = take_alike(&taken, arrays, values, 3, 0);
    PyObject *found = n < 0 ? Py_NewRef(Py_None) : PyFloat_FromDouble(weighed(values[0], values[1], values[2], n));
    give_back(&taken);
    return found;
}

PyDoc_STRVAR(deviation_doc,
"deviation(values, mean, weights) -> float | None\n\n"
"Return (values − mean) · weights of arrays of equal length.");

static PyObject *beyond(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *arrays[3];
    Taken taken = {.n = 0};
    double *values[3], times;
    if (!PyArg_ParseTuple(args, "OOOd", &arrays[0], &arrays[1], &arrays[2], &times))
        return NULL;
    Py_ssize_t n = take_alike(&taken, arrays, values, 3, 0);
    PyObject *found = n < 0 ? Py_NewRef(Py_None) : PyLong_FromSsize_t(n_beyond(values[0], values[1], values[2], times, n));
    give_back(&taken);
    return found;
}

PyDoc_STRVAR(beyond_doc,
"beyond(values, centre, reach, times) -> int | None\n\n"
"Return how many values are further from the centre than so many times their reach.");

static PyObject *follow(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *arrays[2];
    Taken taken = {.n = 0};
    double *values[2], n_rows;
    if (!PyArg_ParseTuple(args, "OOd", &arrays[0], &arrays[1], &n_rows))
        return NULL;
    Py_ssize_t n = take_alike(&taken, arrays, values, 2, PyBUF_WRITABLE);
    if (n >= 0)
        add_to_mean(values[0], values[1], n_rows, n);
    give_back(&taken);
    return PyBool_FromLong(n >= 0);
}

PyDoc_STRVAR(follow_doc,
"follow(mean, values, n) -> bool\n\n"
"Make `mean`, in its place, that of n rows of which `values` are the last; False where it was left alone.");

/* Write how far the last of the places is from each before it, the nearest first, and then `at`; 0 where they do not fit. */
static int write_motion(PyObject *places, PyObject *at, PyObject *features)
{
    Taken taken = {.n = 0};
    Py_ssize_t n_places = PyTuple_Size(places), n_lags = n_places - 1, n;
    int sound = 0, has_tail = at != Py_None;
    const double *newest = n_places < 1 ? NULL : take(&taken, PyTuple_GetItem(places, n_lags), "d", -1, 0), *tail = NULL;
    if (!newest)
        goto end;
    n = taken.buffers[0].len / (Py_ssize_t)sizeof(double);
    double *to = take(&taken, features, "d", (n_lags + has_tail) * taken.buffers[0].len, PyBUF_WRITABLE);
    if (!to || (has_tail && !(tail = take(&taken, at, "d", taken.buffers[0].len, 0))))
        goto end;
    for (Py_ssize_t lag = 1; lag <= n_lags; lag++, to += n) {
        Taken one = {.n = 0};
        const double *place = take(&one, PyTuple_GetItem(places, n_lags - lag), "d", taken.buffers[0].len, 0);
        for (Py_ssize_t i = 0; place && i < n; i++)
            to[i] = newest[i] - place[i];
        give_back(&one);
        if (!place)
            goto end;
    }
    if (tail)
        memcpy(to, tail, (size_t)n * sizeof(double));
    sound = 1;
end:
    give_back(&taken);
    return sound;
}

static PyObject *motion(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *places, *at, *features;
    if (!PyArg_ParseTuple(args, "O!OO", &PyTuple_Type, &places, &at, &features))
        return NULL;
    return PyBool_FromLong(write_motion(places, at, features));
}

PyDoc_STRVAR(motion_doc,
"motion(places, at, features) -> bool\n\n"
"Write into `features` how far the last of a tuple of places is from each before it, the nearest first, and `at`, where that\n"
"is not None. False where that was not done.");

/* Copy what is known of the fingertips; 0 with an error where that is not of their number, or there is no memory. */
static int copy(Fingertips *f, Py_ssize_t n_directions, PyObject *const *arrays, Taken *taken)
{
    const Py_ssize_t rows[] = {2 * f->n_sides, f->n_sides, f->n_sides, n_directions * f->n_sides};
    const int64_t *n_known = take(taken, arrays[4], NULL, rows[0] * (Py_ssize_t)sizeof(int64_t), 0);
    double *copies[4], *to;
    f->values = to = PyMem_Malloc((size_t)(rows[0] + rows[1] + rows[2] + rows[3]) * ROW_BYTES);
    f->tips = PyMem_Calloc((size_t)f->n_sides, sizeof(Fingertip));
    if (!f->values || !f->tips) {
        PyErr_NoMemory();
        return 0;
    }
    for (int i = 0; i < 4; i++) {
        const double *from = take(taken, arrays[i], "d", rows[i] * ROW_BYTES, 0);
        if (!from || !n_known) {
            PyErr_SetString(PyExc_ValueError, "what is known of the fingertips does not fit together");
            return 0;
        }
        copies[i] = memcpy(to, from, (size_t)rows[i] * ROW_BYTES);
        to += rows[i] * MOST_VALUES;
    }
    for (Py_ssize_t i = 0; i < f->n_sides; i++) {
        Fingertip *tip = f->tips + i;
        for (int j = 0; j < 2; j++) {
            tip->known[j] = copies[0] + (2 * i + j) * MOST_VALUES;
            tip->n_known[j] = n_known[2 * i + j];
        }
        tip->jumps_v = copies[1] + i * MOST_VALUES;
        tip->weights = copies[2] + i * MOST_VALUES;
        tip->directions = copies[3] + i * n_directions * MOST_VALUES;
        tip->n_directions = n_directions;
    }
    return f->is_whole = 1;
}

static int fingertips_init(PyObject *self, PyObject *args, PyObject *named)
{
    Fingertips *f = (Fingertips *)self, told = {.n_sides = 0};
    PyObject *arrays[5];
    Py_ssize_t n_directions;
    if (!PyArg_ParseTuple(args, "nnOOOOOnnddd", &told.n_sides, &n_directions, &arrays[0], &arrays[1], &arrays[2],
                          &arrays[3], &arrays[4], &told.limits.fewest_at_rail, &told.limits.fewest_compared,
                          &told.limits.largest_deviation, &told.limits.lost_share, &told.small_v))
        return -1;
    /* Only now: a number that is told may be an object whose own code has made them meanwhile. */
    if (f->values || f->tips || (named && PyDict_Size(named))) {
        PyErr_SetString(PyExc_TypeError, "fingertips are made once, and their arguments have no names");
        return -1;
    }
    if (told.n_sides < 1 || told.n_sides > MOST || n_directions < 0 || n_directions > MOST) {
        PyErr_Format(PyExc_ValueError, "%zd fingertips with %zd directions each", told.n_sides, n_directions);
        return -1;
    }
    f->n_sides = told.n_sides;
    f->limits = told.limits;
    f->small_v = told.small_v;
    Taken taken = {.n = 0};
    int sound = copy(f, n_directions, arrays, &taken);
    give_back(&taken);
    return sound ? 0 : -1;
}

static void fingertips_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    PyMem_Free(((Fingertips *)self)->tips);
    PyMem_Free(((Fingertips *)self)->values);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef fingertips_methods[] = {
    {"check", check, METH_VARARGS, check_doc},
    {"placed", placed, METH_VARARGS, placed_doc},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot fingertips_slots[] = {
    {Py_tp_doc, "What frames are compared with; see bank/compiled.py."},
    {Py_tp_init, fingertips_init},
    {Py_tp_dealloc, fingertips_dealloc},
    {Py_tp_methods, fingertips_methods},
    {0, NULL},
};

static PyType_Spec fingertips_spec = {
    .name = "bank._frames.Fingertips",
    .basicsize = sizeof(Fingertips),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = fingertips_slots,
};

static PyMethodDef module_functions[] = {
    {"all_finite", all_finite, METH_O, all_finite_doc},
    {"beyond", beyond, METH_VARARGS, beyond_doc},
    {"compared", compared, METH_VARARGS, compared_doc},
    {"deviation", deviation, METH_VARARGS, deviation_doc},
    {"follow", follow, METH_VARARGS, follow_doc},
    {"medians", medians, METH_VARARGS, medians_doc},
    {"motion", motion, METH_VARARGS, motion_doc},
    {"n_largest", n_largest, METH_O, n_largest_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "bank._frames",
    .m_doc = "What estimators do with a frame in many calls of numpy, in one.",
    .m_size = -1,
    .m_methods = module_functions,
};

PyMODINIT_FUNC PyInit__frames(void)
{
    PyObject *found = PyModule_Create(&module);
    PyObject *type = found ? PyType_FromSpec(&fingertips_spec) : NULL;
    if (!type || PyModule_AddObjectRef(found, "Fingertips", type) < 0
        || PyModule_AddIntConstant(found, "SOURCES", SOURCES) < 0)
        Py_CLEAR(found);
    Py_XDECREF(type);
    return found;
}
