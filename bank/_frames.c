/* bank/look.c and bank/medians.c for Python: what estimators that know their fingertip ask of each frame.

   Kinds and sizes of the arrays that are handed in are checked, for they decide where is read. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "look.h"

#include <string.h>

enum { MOST = 1024, MOST_ARRAYS = 9, ROW = MOST_VALUES };

typedef struct {
    PyObject_HEAD
    Py_ssize_t n_sides;
    Fingertip *tips;
    double *values; /* what they point to */
    int some_lost;  /* of at least one of them */
    int is_whole;   /* all of it is there */
    Limits limits;
    double small_v;
} Fingertips;

/* Arrays that are looked at, until they are given back, and a number told with them. */
typedef struct {
    Py_buffer buffers[MOST_ARRAYS];
    void *values[MOST_ARRAYS];
    Py_ssize_t n_values[MOST_ARRAYS];
    int n;
    double number;
} Taken;

/* Sizes of arrays: as many values as the first, and whatever it is. */
enum { AS_FIRST = -1, ANY = -2 };
#define SIZES (const Py_ssize_t[])

/* Take one more array of float64 (kind d), the same to be written to (w), bool (b) or int64 (i, whose letter is its platform's)
   of so many values; 0 for another one, or one in pieces. */
static int take(Taken *taken, PyObject *array, char kind, Py_ssize_t size)
{
    Py_buffer *buffer = &taken->buffers[taken->n];
    const char *letters = kind == 'i' ? "lq" : kind == 'b' ? "?" : "d";
    Py_ssize_t n_bytes = kind == 'b' ? 1 : 8;
    if (PyObject_GetBuffer(array, buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (kind == 'w' ? PyBUF_WRITABLE : 0)) < 0) {
        PyErr_Clear();
        return 0;
    }
    Py_ssize_t n = taken->n_values[taken->n] = buffer->len / n_bytes;
    taken->values[taken->n++] = buffer->buf;
    const char *format = buffer->format;
    return format && format[0] && strchr(letters, format[0]) && !format[1] && buffer->itemsize == n_bytes
        && (size == ANY || n == (size == AS_FIRST ? taken->n_values[0] : size));
}

/* Take all arguments, each an array but for a last one of kind f, a number; 0 where they are others, with an error only where
   there are more or fewer, or that is none. */
static int take_all(Taken *taken, PyObject *args, const char *kinds, const Py_ssize_t *sizes)
{
    taken->n = 0;
    if (PyTuple_Size(args) != (Py_ssize_t)strlen(kinds)) {
        PyErr_Format(PyExc_TypeError, "%zd arguments instead of %zu", PyTuple_Size(args), strlen(kinds));
        return 0;
    }
    for (int i = 0; kinds[i]; i++)
        if (kinds[i] == 'f') {
            taken->number = PyFloat_AsDouble(PyTuple_GetItem(args, i));
            if (PyErr_Occurred())
                return 0;
        } else if (!take(taken, PyTuple_GetItem(args, i), kinds[i], sizes[i])) {
            return 0;
        }
    return 1;
}

/* Give all arrays back and return what was found; with an error where they were not what they should have been. */
static PyObject *done(Taken *taken, PyObject *found, const char *wrong)
{
    while (taken->n)
        PyBuffer_Release(&taken->buffers[--taken->n]);
    if (!found && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, wrong);
    return found;
}

/* The same, with None where there is nothing: numpy does it, or says what is wrong. */
static PyObject *done_or_none(Taken *taken, PyObject *found)
{
    return done(taken, found || PyErr_Occurred() ? found : Py_NewRef(Py_None), NULL);
}

/* Put an item, NULL where none could be made, into a list, which is given up where that fails. */
static void put(PyObject **list, Py_ssize_t i, PyObject *item)
{
    if (!item || PyList_SetItem(*list, i, item) < 0)
        Py_CLEAR(*list);
}

static PyObject *medians(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "di", SIZES{ANY, ANY}) && taken.n_values[0] == taken.n_values[1] * ROW) {
        const double *rows = taken.values[0];
        const int64_t *counts = taken.values[1];
        found = PyList_New(taken.n_values[1]);
        for (Py_ssize_t i = 0; found && i < taken.n_values[1]; i++)
            put(&found, i, PyFloat_FromDouble(median_of(rows + i * ROW, counts[i])));
    }
    return done(&taken, found, "medians are taken of (n, 896) float64 rows, of as many values of each as n int64 counts say");
}

PyDoc_STRVAR(medians_doc,
"medians(rows, counts) -> list of float\n\n"
"Return the median of each of (n, 896) float64 rows, in order with NaN last, of its first counts (n,) int64 values.");

static PyObject *off_from_each(const double *known, const double *frame, const int64_t *counts, Py_ssize_t n,
                               Py_ssize_t n_each, double *off)
{
    PyObject *found = PyList_New(n);
    for (Py_ssize_t i = 0; found && i < n; i++) {
        compare(known + i * ROW, frame + i / n_each * ROW, counts[i], off + i * ROW);
        put(&found, i, PyFloat_FromDouble(median_of(off + i * ROW, counts[i])));
    }
    return found;
}

static PyObject *compared(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "ddiw", SIZES{ANY, ANY, ANY, AS_FIRST})) {
        Py_ssize_t n_rows = taken.n_values[1] / ROW, n = taken.n_values[2];
        if (n_rows > 0 && taken.n_values[1] == n_rows * ROW && n % n_rows == 0 && taken.n_values[0] == n * ROW)
            found = off_from_each(taken.values[0], taken.values[1], taken.values[2], n, n / n_rows, taken.values[3]);
    }
    return done(&taken, found,
                "a frame is (m, 896) float64 values, and compared with (m, k, 896), of which m·k int64 counts tell how many "
                "are known; as many are written");
}

PyDoc_STRVAR(compared_doc,
"compared(known, frame, counts, off) -> list of float\n\n"
"Write by which shares a (m, 896) frame is off from each of (m, k, 896) known ones into `off`, all float64, and return the\n"
"medians: of each known row so many values count as counts (m·k) int64 say, the others are NaN.");

static PyObject *n_largest(PyObject *module, PyObject *array)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken = {.n = 0};
    if (take(&taken, array, 'd', ANY) && taken.n_values[0] % ROW == 0) {
        const double *rows = taken.values[0];
        Py_ssize_t n = taken.n_values[0] / ROW;
        found = PyList_New(n);
        for (Py_ssize_t i = 0; found && i < n; i++)
            put(&found, i, PyLong_FromLong(n_largest_of(rows + i * ROW)));
    }
    return done(&taken, found, "the largest are counted in (n, 896) float64 rows");
}

PyDoc_STRVAR(n_largest_doc,
"n_largest(rows) -> list of int\n\n"
"Return how many of each of (n, 896) float64 rows are its largest.");

static Fingertips *fingertips_of(PyObject *self)
{
    if (((Fingertips *)self)->is_whole)
        return (Fingertips *)self;
    PyErr_SetString(PyExc_ValueError, "these are no fingertips");
    return NULL;
}

/* Whether masks are those that the fingertips were made for. */
static int are_told(const Fingertips *f, const unsigned char *told, const unsigned char *lost)
{
    for (Py_ssize_t i = 0; i < f->n_sides; i++)
        if (memcmp(told + i * ROW, f->tips[i].told, ROW) || (f->some_lost && memcmp(lost + i * ROW, f->tips[i].lost, ROW)))
            return 0;
    return 1;
}

static int are_usable(const Fingertips *f, const unsigned char *usable)
{
    for (Py_ssize_t i = 0; i < f->n_sides; i++)
        if (memcmp(usable + i * ROW, f->tips[i].usable, ROW))
            return 0;
    return 1;
}

static int are_ordinary(const Fingertips *f, const double *frame)
{
    for (Py_ssize_t i = 0; i < f->n_sides; i++)
        if (!is_ordinary(f->tips + i, &f->limits, frame + i * ROW))
            return 0;
    return 1;
}

static PyObject *jumping(const Fingertips *f, const double *frame, const double *before)
{
    PyObject *found = PyList_New(f->n_sides);
    for (Py_ssize_t i = 0; found && i < f->n_sides; i++)
        put(&found, i, PyLong_FromLong(n_jumping(f->tips + i, frame + i * ROW, before + i * ROW)));
    return found;
}

static PyObject *check(PyObject *self, PyObject *args)
{
    const Fingertips *f = fingertips_of(self);
    PyObject *found = NULL;
    Taken taken;
    if (!f)
        return NULL;
    if (take_all(&taken, args, "dbbd", SIZES{f->n_sides * ROW, AS_FIRST, AS_FIRST, AS_FIRST})
        && are_told(f, taken.values[1], taken.values[2]) && are_ordinary(f, taken.values[0]))
        found = jumping(f, taken.values[0], taken.values[3]);
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(check_doc,
"check(frame, told, lost, before) -> list of int | None\n\n"
"Return how many usable channels of each side jump since the frame before; all (m, 896). None of a frame that is not ordinary,\n"
"or is told to be usable elsewhere; and of one before which others were lost, where any are.");

static PyObject *fill_in(PyObject *self, PyObject *args)
{
    const Fingertips *f = fingertips_of(self);
    Taken taken;
    if (!f)
        return NULL;
    int sound = take_all(&taken, args, "wd", SIZES{f->n_sides * ROW, AS_FIRST});
    for (Py_ssize_t i = 0; sound && i < f->n_sides; i++)
        fill(f->tips + i, (double *)taken.values[0] + i * ROW, (const double *)taken.values[1] + i * ROW);
    return done(&taken, sound ? Py_NewRef(Py_None) : NULL, "channels and those before are (m, 896) float64 values");
}

PyDoc_STRVAR(fill_in_doc,
"fill_in(channels, before)\n\n"
"Move those of (m, 896) channels that are not usable on from where they were before, as the usable ones say.");

static PyObject *all_placed(const Fingertips *f, const Taken *taken)
{
    PyObject *found = PyList_New(f->n_sides);
    const double *frame = taken->values[0], *idle = taken->values[2], *gains = taken->values[3];
    double *difference = taken->values[4], *places = taken->values[5];
    for (Py_ssize_t i = 0; found && i < f->n_sides; i++) {
        Py_ssize_t at = i * ROW, n = f->tips->n_directions;
        put(&found, i, PyFloat_FromDouble(place(f->tips + i, f->small_v, frame + at, idle + at, gains[i], difference + at,
                                                places + i * n, places + (f->n_sides + i) * n)));
    }
    return found;
}

static PyObject *placed(PyObject *self, PyObject *args)
{
    const Fingertips *f = fingertips_of(self);
    PyObject *found = NULL;
    Taken taken;
    if (!f)
        return NULL;
    Py_ssize_t n_places = 2 * f->n_sides * f->tips->n_directions;
    if (take_all(&taken, args, "dbddww", SIZES{f->n_sides * ROW, AS_FIRST, AS_FIRST, f->n_sides, AS_FIRST, n_places})
        && are_usable(f, taken.values[1]))
        found = all_placed(f, &taken);
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(placed_doc,
"placed(frame, usable, idle, gains, difference, places) -> list of float | None\n\n"
"Return the score of each side's grip, and write the (m, 896) difference to the idle frame at the calibration's gain, and\n"
"where the frame at that gain, and the difference, lie along the directions, (2, m, p). None where others are usable.");

static PyObject *all_finite(PyObject *module, PyObject *array)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken = {.n = 0};
    if (take(&taken, array, 'd', ANY))
        found = PyBool_FromLong(are_finite(taken.values[0], taken.n_values[0]));
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(all_finite_doc,
"all_finite(values) -> bool | None\n\n"
"Return whether all of an array are finite; None of one that is not float64, or in pieces, as the others here.");

static PyObject *deviation(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "ddd", SIZES{ANY, AS_FIRST, AS_FIRST}))
        found = PyFloat_FromDouble(weighed(taken.values[0], taken.values[1], taken.values[2], taken.n_values[0]));
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(deviation_doc,
"deviation(values, mean, weights) -> float | None\n\n"
"Return (values − mean) · weights of arrays of equal length.");

static PyObject *beyond(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "dddf", SIZES{ANY, AS_FIRST, AS_FIRST}))
        found = PyLong_FromSsize_t(
            n_beyond(taken.values[0], taken.values[1], taken.values[2], taken.number, taken.n_values[0]));
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(beyond_doc,
"beyond(values, centre, reach, times) -> int | None\n\n"
"Return how many values are further from the centre than so many times their reach.");

static PyObject *follow(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "wdf", SIZES{ANY, AS_FIRST})) {
        add_to_mean(taken.values[0], taken.values[1], taken.number, taken.n_values[0]);
        found = Py_NewRef(Py_True);
    }
    return done_or_none(&taken, found);
}

PyDoc_STRVAR(follow_doc,
"follow(mean, values, n) -> True | None\n\n"
"Make `mean`, in its place, that of n rows of which `values` are the last; None where it was left alone.");

/* Write how far the last of the places is from one before it; 0 where that one is not as long. */
static int write_moved(const double *newest, Py_ssize_t n, PyObject *place, double *to)
{
    Taken taken = {.n = 0};
    int sound = take(&taken, place, 'd', n);
    for (Py_ssize_t i = 0; sound && i < n; i++)
        to[i] = newest[i] - ((const double *)taken.values[0])[i];
    Py_XDECREF(done_or_none(&taken, NULL));
    return sound;
}

static PyObject *motion(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *places, *at, *features;
    Taken taken = {.n = 0};
    if (!PyArg_ParseTuple(args, "O!OO", &PyTuple_Type, &places, &at, &features))
        return NULL;
    Py_ssize_t n_lags = PyTuple_Size(places) - 1;
    int has_tail = at != Py_None;
    int sound = n_lags >= 0 && take(&taken, PyTuple_GetItem(places, n_lags), 'd', ANY)
        && take(&taken, features, 'w', (n_lags + has_tail) * taken.n_values[0]) && (!has_tail || take(&taken, at, 'd', AS_FIRST));
    if (sound) {
        Py_ssize_t n = taken.n_values[0];
        double *to = taken.values[1];
        for (Py_ssize_t lag = 1; sound && lag <= n_lags; lag++, to += n)
            sound = write_moved(taken.values[0], n, PyTuple_GetItem(places, n_lags - lag), to);
        if (sound && has_tail)
            memcpy(to, taken.values[2], (size_t)n * sizeof(double));
    }
    return done(&taken, PyBool_FromLong(sound), NULL);
}

PyDoc_STRVAR(motion_doc,
"motion(places, at, features) -> bool\n\n"
"Write into `features` how far the last of a tuple of places is from each before it, the nearest first, and `at`, where that\n"
"is not None. False where that was not done.");

/* What is told of a fingertip's channels, as 0 and 1. */
static void note_masks(Fingertip *tip, const unsigned char *told, const unsigned char *lost)
{
    for (int i = 0; i < ROW; i++) {
        tip->told[i] = told[i] != 0;
        tip->lost[i] = lost[i] != 0;
        tip->usable[i] = tip->told[i] && !tip->lost[i];
        tip->unusable[tip->n_unusable] = i;
        tip->n_unusable += !tip->usable[i];
    }
}

/* Copy what is known of the fingertips, in arrays as `fingertips_init` takes them; 0 without memory for it. */
static int copy(Fingertips *f, Py_ssize_t n_directions, Py_ssize_t n_moves, const Taken *taken)
{
    double *copies[6], *to;
    Py_ssize_t n_values = 0;
    for (int i = 0; i < 6; i++)
        n_values += taken->n_values[i];
    f->values = to = PyMem_Malloc((size_t)n_values * sizeof(double));
    f->tips = PyMem_Calloc((size_t)f->n_sides, sizeof(Fingertip));
    if (!f->values || !f->tips)
        return 0;
    for (int i = 0; i < 6; to += taken->n_values[i++])
        copies[i] = memcpy(to, taken->values[i], (size_t)taken->n_values[i] * sizeof(double));
    for (Py_ssize_t i = 0; i < f->n_sides; i++) {
        Fingertip *tip = f->tips + i;
        const double *reads = copies[4] + i * n_moves * ROW, *shapes = copies[5] + i * n_moves * ROW;
        Py_ssize_t n_steps = n_moves / 2;
        for (int j = 0; j < 2; j++) {
            tip->known[j] = copies[0] + (2 * i + j) * ROW;
            tip->n_known[j] = ((const int64_t *)taken->values[6])[2 * i + j];
        }
        tip->jumps_v = copies[1] + i * ROW;
        tip->weights = copies[2] + i * ROW;
        tip->directions = copies[3] + i * n_directions * ROW;
        tip->n_directions = n_directions;
        tip->steps = (Moves){reads, shapes, n_steps};
        tip->grips = (Moves){reads + n_steps * ROW, shapes + n_steps * ROW, n_moves - n_steps};
        note_masks(tip, (const unsigned char *)taken->values[7] + i * ROW, (const unsigned char *)taken->values[8] + i * ROW);
        f->some_lost |= memchr(tip->lost, 1, ROW) != NULL;
    }
    return f->is_whole = 1;
}

static int fingertips_init(PyObject *self, PyObject *args, PyObject *named)
{
    Fingertips *f = (Fingertips *)self, told = {.n_sides = 0};
    PyObject *arrays, *made = NULL;
    Py_ssize_t n_directions, n_moves;
    if (!PyArg_ParseTuple(args, "nnnO!nnddd", &told.n_sides, &n_directions, &n_moves, &PyTuple_Type, &arrays,
                          &told.limits.fewest_at_rail, &told.limits.fewest_compared, &told.limits.largest_deviation,
                          &told.limits.lost_share, &told.small_v))
        return -1;
    if (told.n_sides < 1 || told.n_sides > MOST || n_directions < 0 || n_directions > MOST || n_moves < 0 || n_moves > MOST) {
        PyErr_Format(PyExc_ValueError, "%zd fingertips with %zd directions and %zd moves each", told.n_sides, n_directions,
                     n_moves);
        return -1;
    }
    Taken taken;
    Py_ssize_t n = told.n_sides * ROW;
    int sound = take_all(&taken, arrays, "ddddddibb",
                         SIZES{2 * n, n, n, n_directions * n, n_moves * n, n_moves * n, 2 * told.n_sides, n, n});
    /* Only now: what is told may be an object whose own code has made them meanwhile. */
    if (f->values || f->tips || (named && PyDict_Size(named))) {
        PyErr_SetString(PyExc_TypeError, "fingertips are made once, and their arguments have no names");
    } else if (sound) {
        f->n_sides = told.n_sides;
        f->limits = told.limits;
        f->small_v = told.small_v;
        made = copy(f, n_directions, n_moves, &taken) ? Py_NewRef(Py_None) : PyErr_NoMemory();
    }
    Py_XDECREF(done(&taken, made, "what is known of the fingertips does not fit together, or is of another kind"));
    return made ? 0 : -1;
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
    {"fill_in", fill_in, METH_VARARGS, fill_in_doc},
    {"placed", placed, METH_VARARGS, placed_doc},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot fingertips_slots[] = {
    {Py_tp_doc, "What frames are compared with; see bank/compiled_frames.py."},
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
