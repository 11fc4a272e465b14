/* bank/look.c and bank/medians.c for Python: what estimators that know their fingertip ask of arrays of each frame. */

#include "_fingertips.h"
#include "arrays.h"
#include "look.h"

#include <string.h>

enum { ROW = MOST_VALUES };

static PyObject *medians(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *found = NULL;
    Taken taken;
    if (take_all(&taken, args, "dq", SIZES{ANY, ANY}) && taken.n_values[0] == taken.n_values[1] * ROW) {
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
    if (take_all(&taken, args, "ddqw", SIZES{ANY, ANY, ANY, AS_FIRST})) {
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
    if (take_all(&taken, args, "dddn", SIZES{ANY, AS_FIRST, AS_FIRST}))
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
    if (take_all(&taken, args, "wdn", SIZES{ANY, AS_FIRST})) {
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
