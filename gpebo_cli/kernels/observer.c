/* gpebo_cli/observers, excitation.py, regression.py. */
#include "common.h"

PyMethodDef observer_kernels[] = {
    {NULL, NULL, 0, NULL},
};
