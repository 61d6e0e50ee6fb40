/* The compiled kernels as one module; see gpebo_cli/kernels/__init__.py. */
#define GPEBO_MODULE
#include "common.h"

int add_all_kernels(PyObject *module);

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_compiled", "Inner loops in C.", -1, NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__compiled(void)
{
    import_array();
    PyObject *module = PyModule_Create(&definition);
    if (module == NULL)
        return NULL;
    PyMethodDef *subjects[] = {
        jets_kernels, intervals_kernels,
    };
    for (size_t i = 0; i < sizeof(subjects) / sizeof(subjects[0]); i++)
        if (PyModule_AddFunctions(module, subjects[i]) < 0) {
            Py_DECREF(module);
            return NULL;
        }
    if (add_all_kernels(module) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
