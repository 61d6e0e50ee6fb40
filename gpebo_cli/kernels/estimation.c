/* gpebo_cli/estimators, metrics.py, experiment.py. */
#include "common.h"

PyMethodDef estimation_kernels[] = {
    {NULL, NULL, 0, NULL},
};
