/* The compiled kernels as one module; see gpebo_cli/kernels/__init__.py. */
#define GPEBO_MODULE
#include "kernel.h"

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_compiled", "Inner loops in C.", -1, NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__compiled(void)
{
    import_array();
    PyObject *module = PyModule_Create(&definition);
    if (module != NULL && add_all_kernels(module) < 0)
        Py_CLEAR(module);
    return module;
}
