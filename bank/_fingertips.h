#ifndef FINGERTIPS_H
#define FINGERTIPS_H

#include "arrays.h"

/* The type `Fingertips`; see bank/_frames.pyi. */
extern PyType_Spec fingertips_spec;

#endif
