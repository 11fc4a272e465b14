/* A line of the EIT-kit, checked and read, and its channels compared with those before: what drivers/eit_format.py and
   drivers/eit_line.py do with several calls of numpy, in one each. Each call of numpy costs some ten microseconds when
   others have had the processor's caches. */

#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdint.h>

#define VALUES 1024
#define CELL_BYTES 8
#define TEN_THOUSANDTHS 10000.0

/* The ten thousandths of a cell `d.dddd, `, or −1 for any other eight bytes. */
static int32_t ten_thousandths(const unsigned char *cell)
{
    static const int32_t places[CELL_BYTES] = {10000, 0, 1000, 100, 10, 1, 0, 0};
    int32_t sum = 0;
    for (int i = 0; i < CELL_BYTES; i++) {
        if (!places[i])
            continue;
        unsigned digit = (unsigned)cell[i] - '0';
        if (digit > 9)
            return -1;
        sum += places[i] * (int32_t)digit;
    }
    return cell[1] == '.' && cell[6] == ',' && cell[7] == ' ' ? sum : -1;
}

static PyObject *read_line(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer line, zero_slots, values;
    double most;
    if (!PyArg_ParseTuple(args, "y*y*dw*", &line, &zero_slots, &most, &values))
        return NULL;
    int sound = line.len == VALUES * CELL_BYTES && zero_slots.len == VALUES
        && values.len == VALUES * (Py_ssize_t)sizeof(double);
    for (int i = 0; sound && i < VALUES; i++) {
        int32_t cell = ten_thousandths((const unsigned char *)line.buf + i * CELL_BYTES);
        /* The quotient of whole numbers below 10⁵ is the same double that float() reads. */
        double value = cell / TEN_THOUSANDTHS;
        ((double *)values.buf)[i] = value;
        sound = cell >= 0 && value <= most && (cell == 0) == ((const char *)zero_slots.buf)[i];
    }
    PyBuffer_Release(&line);
    PyBuffer_Release(&zero_slots);
    PyBuffer_Release(&values);
    return PyBool_FromLong(sound);
}

PyDoc_STRVAR(read_doc,
"read(line, zero_slots, most, values) -> bool\n\n"
"Whether a line is 1024 cells `d.dddd, `, 0 where `zero_slots` (1024,) says so and nowhere else, none above `most`; if\n"
"so, `values` (1024,) float64 are these.");

static PyObject *look(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer channels, before, changed_in;
    long long number;
    double full_scale;
    if (!PyArg_ParseTuple(args, "y*y*w*Ld", &channels, &before, &changed_in, &number, &full_scale))
        return NULL;
    Py_ssize_t n = channels.len / (Py_ssize_t)sizeof(double);
    int fits = before.len == channels.len && changed_in.len == n * (Py_ssize_t)sizeof(int64_t);
    int saturated = 0;
    for (Py_ssize_t i = 0; fits && i < n; i++) {
        double now = ((const double *)channels.buf)[i];
        if (now != ((const double *)before.buf)[i])
            ((int64_t *)changed_in.buf)[i] = number;
        saturated |= now > full_scale;
    }
    PyBuffer_Release(&channels);
    PyBuffer_Release(&before);
    PyBuffer_Release(&changed_in);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "as many channels as before, and as many numbers, are what can be compared");
        return NULL;
    }
    return PyBool_FromLong(saturated);
}

PyDoc_STRVAR(look_doc,
"look(channels, before, changed_in, number, full_scale) -> bool\n\n"
"Note the number in `changed_in`, int64, of every channel that is not what it was before, both float64; whether one is\n"
"above full_scale.");

static PyMethodDef functions[] = {
    {"look", look, METH_VARARGS, look_doc},
    {"read", read_line, METH_VARARGS, read_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "drivers._cells",
    .m_doc = "The cells of the EIT-kit's lines.",
    .m_size = -1,
    .m_methods = functions,
};

PyMODINIT_FUNC PyInit__cells(void)
{
    PyObject *found = PyModule_Create(&module);
    if (found && PyModule_AddIntConstant(found, "SOURCES", SOURCES) < 0)
        Py_CLEAR(found);
    return found;
}
