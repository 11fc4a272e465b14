/* Arrays of Python that compiled code reads and writes. Their kinds and sizes are checked, for they decide where. */

#include "arrays.h"

#include <string.h>

/* How a kind is written: its letters in the buffer protocol, those of integers being their platform's, and how many bytes. */
static const struct {
    char kind;
    const char *letters;
    Py_ssize_t n_bytes;
} WRITTEN[] = {{'d', "d", 8}, {'w', "d", 8}, {'f', "f", 4}, {'q', "lq", 8}, {'i', "il", 4}, {'b', "?", 1}};

static int is_of_kind(const Py_buffer *buffer, char kind)
{
    const char *format = buffer->format;
    int i = 0;
    while (WRITTEN[i].kind != kind)
        i++;
    return format && format[0] && strchr(WRITTEN[i].letters, format[0]) && !format[1]
        && buffer->itemsize == WRITTEN[i].n_bytes;
}

int take_array(Py_buffer *buffer, PyObject *array, char kind)
{
    if (PyObject_GetBuffer(array, buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (kind == 'w' ? PyBUF_WRITABLE : 0)) < 0) {
        PyErr_Clear();
        return 0;
    }
    if (is_of_kind(buffer, kind))
        return 1;
    PyBuffer_Release(buffer);
    return 0;
}

int take(Taken *taken, PyObject *array, char kind, Py_ssize_t size)
{
    Py_buffer *buffer = &taken->buffers[taken->n];
    if (!take_array(buffer, array, kind))
        return 0;
    Py_ssize_t n = taken->n_values[taken->n] = buffer->len / buffer->itemsize;
    taken->values[taken->n++] = buffer->buf;
    return size == ANY || n == (size == AS_FIRST ? taken->n_values[0] : size);
}

int take_all(Taken *taken, PyObject *args, const char *kinds, const Py_ssize_t *sizes)
{
    taken->n = 0;
    if (PyTuple_Size(args) != (Py_ssize_t)strlen(kinds)) {
        PyErr_Format(PyExc_TypeError, "%zd arguments instead of %zu", PyTuple_Size(args), strlen(kinds));
        return 0;
    }
    for (int i = 0; kinds[i]; i++)
        if (kinds[i] == 'n') {
            taken->number = PyFloat_AsDouble(PyTuple_GetItem(args, i));
            if (PyErr_Occurred())
                return 0;
        } else if (!take(taken, PyTuple_GetItem(args, i), kinds[i], sizes[i])) {
            return 0;
        }
    return 1;
}

PyObject *done(Taken *taken, PyObject *found, const char *wrong)
{
    while (taken->n)
        PyBuffer_Release(&taken->buffers[--taken->n]);
    if (!found && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, wrong);
    return found;
}

PyObject *done_or_none(Taken *taken, PyObject *found)
{
    return done(taken, found || PyErr_Occurred() ? found : Py_NewRef(Py_None), NULL);
}

void put(PyObject **list, Py_ssize_t i, PyObject *item)
{
    if (!item || PyList_SetItem(*list, i, item) < 0)
        Py_CLEAR(*list);
}
