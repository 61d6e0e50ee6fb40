/* gpebo_cli/collocation/linear.py: element systems, chaining, error estimates. */
#include "common.h"

PyMethodDef collocation_kernels[] = {
    {NULL, NULL, 0, NULL},
};
