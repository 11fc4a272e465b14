#ifndef ARRAYS_H
#define ARRAYS_H

/* Every file that is compiled for Python includes this first. */
#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

enum { MOST_ARRAYS = 9 };

/* Take an array to be read until its buffer is released, of a kind: d float64, w float64 that may be written to, f float32,
   q int64, i int32, b bool; 0, with nothing taken and no error, for another one, one in pieces, and what is no array. */
int take_array(Py_buffer *buffer, PyObject *array, char kind);

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

/* Take one more array of so many values; 0 as above. */
int take(Taken *taken, PyObject *array, char kind, Py_ssize_t size);

/* Take all arguments, each an array but for a last one of kind n, a number; 0 where they are others, with an error only where
   there are more or fewer, or that is none. */
int take_all(Taken *taken, PyObject *args, const char *kinds, const Py_ssize_t *sizes);

/* Give all arrays back and return what was found; with an error where they were not what they should have been. */
PyObject *done(Taken *taken, PyObject *found, const char *wrong);

/* The same, with None where there is nothing: numpy does it, or says what is wrong. */
PyObject *done_or_none(Taken *taken, PyObject *found);

/* Put an item, NULL where none could be made, into a list, which is given up where that fails. */
void put(PyObject **list, Py_ssize_t i, PyObject *item);

#endif
