/* bank/look.c for Python: what is known of fingertips while the same of their channels are usable, and what it says of a
   frame. */

#include "_fingertips.h"
#include "arrays.h"
#include "look.h"

#include <string.h>

enum { MOST = 1024, ROW = MOST_VALUES };

typedef struct {
    PyObject_HEAD
    Py_ssize_t n_sides;
    Fingertip *tips;
    double *values; /* what they point to */
    int some_lost;  /* of at least one of them */
    int is_whole;   /* all of it is there */
    Limits limits;
    double small_v;
    PyObject *made_of; /* the arguments */
} Fingertips;

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
    int sound = take_all(&taken, arrays, "ddddddqbb",
                         SIZES{2 * n, n, n, n_directions * n, n_moves * n, n_moves * n, 2 * told.n_sides, n, n});
    /* Only now: what is told may be an object whose own code has made them meanwhile. */
    if (f->values || f->tips || (named && PyDict_Size(named))) {
        PyErr_SetString(PyExc_TypeError, "fingertips are made once, and their arguments have no names");
    } else if (sound) {
        f->n_sides = told.n_sides;
        f->limits = told.limits;
        f->small_v = told.small_v;
        f->made_of = Py_NewRef(args);
        made = copy(f, n_directions, n_moves, &taken) ? Py_NewRef(Py_None) : PyErr_NoMemory();
    }
    Py_XDECREF(done(&taken, made, "what is known of the fingertips does not fit together, or is of another kind"));
    return made ? 0 : -1;
}

static PyObject *reduce(PyObject *self, PyObject *nothing)
{
    const Fingertips *f = fingertips_of(self);
    (void)nothing;
    return f ? PyTuple_Pack(2, (PyObject *)Py_TYPE(self), f->made_of) : NULL;
}

PyDoc_STRVAR(reduce_doc,
"__reduce__() -> tuple\n\n"
"Return what makes the same fingertips again, for copies and for other processes.");

static void fingertips_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    Py_XDECREF(((Fingertips *)self)->made_of);
    PyMem_Free(((Fingertips *)self)->tips);
    PyMem_Free(((Fingertips *)self)->values);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyMethodDef fingertips_methods[] = {
    {"__reduce__", reduce, METH_NOARGS, reduce_doc},
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

PyType_Spec fingertips_spec = {
    .name = "bank._frames.Fingertips",
    .basicsize = sizeof(Fingertips),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = fingertips_slots,
};
