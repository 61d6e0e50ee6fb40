/* gpebo_cli/collocation/mesh.py: signals on a mesh, how well it resolves them, sampling, filters. */
#include "common.h"

PyMethodDef mesh_kernels[] = {
    {NULL, NULL, 0, NULL},
};
