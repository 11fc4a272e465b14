/* bank/medians.c for Python: what estimators that know their fingertip ask of each frame.

   The arrays that are handed in come of bank/compiled.py; their sizes are checked, for they decide where is read. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "medians.h"

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
        put(&found, i, PyFloat_FromDouble(off_from(known + at, row, counts[i], off + at)));
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

static PyMethodDef module_functions[] = {
    {"compared", compared, METH_VARARGS, compared_doc},
    {"medians", medians, METH_VARARGS, medians_doc},
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
    if (found && PyModule_AddIntConstant(found, "SOURCES", SOURCES) < 0)
        Py_CLEAR(found);
    return found;
}
