#ifndef LOOK_H
#define LOOK_H

#include "medians.h"

#include <stddef.h>

/* What is known of one fingertip: arrays of 896 values. */
typedef struct {
    const double *known[2];   /* its frames, idle and gripped; NaN where none is compared */
    int64_t n_known[2];       /* how many of each are no NaN */
    const double *jumps_v;    /* a channel that moves further from frame to frame is disturbed */
    const double *weights;    /* of the grip's score */
    const double *directions; /* (n_directions, 896), along which motion is measured */
    ptrdiff_t n_directions;
} Fingertip;

/* Beyond these a frame is no ordinary one. */
typedef struct {
    ptrdiff_t fewest_at_rail;  /* channels that share its largest value */
    double largest_deviation;  /* by which the middle one of the channels is off from the known frame that is nearer … */
    ptrdiff_t fewest_compared; /* … where so many are compared */
    double lost_share;         /* by which a channel is off from both known frames */
} Limits;

/* Whether nothing speaks against a frame but what may have happened since the frame before: it is finite, none of its channels
   is at the rail or lost, and it is surely of this fingertip. */
int is_ordinary(const Fingertip *tip, const Limits *limits, const double *frame);

/* How many channels jump from the frame before. */
int n_jumping(const Fingertip *tip, const double *frame, const double *before);

/* The grip's score, where `small_v` is added to voltages that others are divided by, the 896 differences to the idle frame at
   the calibration's gain, and where the frame at that gain, and its difference, lie along each of the directions. */
double place(const Fingertip *tip, double small_v, const double *frame, const double *idle, double gain, double *difference,
             double *places, double *placed);

/* Of n values. Whether all are finite. */
int are_finite(const double *values, ptrdiff_t n);

/* Their deviations from a mean, each times its weight, in sum. */
double weighed(const double *values, const double *mean, const double *weights, ptrdiff_t n);

/* How many are further from the centre than so many times their reach. */
ptrdiff_t n_beyond(const double *values, const double *centre, const double *reach, double times, ptrdiff_t n);

/* Make a mean of n_rows − 1 rows that of n_rows, of which these values are the last. */
void add_to_mean(double *mean, const double *values, double n_rows, ptrdiff_t n);

#endif
