/* gpebo_cli/expressions: Taylor coefficients of all entries of a plant. */
#include "common.h"

PyMethodDef jets_kernels[] = {
    {NULL, NULL, 0, NULL},
};
