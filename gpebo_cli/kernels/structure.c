/* gpebo_cli/simulation: derivative arrays, the strangeness-free system, consistent states. */
#include "common.h"

PyMethodDef structure_kernels[] = {
    {NULL, NULL, 0, NULL},
};
