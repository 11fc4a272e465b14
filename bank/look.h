#ifndef LOOK_H
#define LOOK_H

#include "medians.h"

#include <stddef.h>

/* Directions (n, 896) that a frame moves along, and what each channel that is usable tells of how far it moved along them. */
typedef struct {
    const double *reads, *shapes;
    ptrdiff_t n;
} Moves;

/* What is known of one fingertip while the same of its channels are usable: arrays of 896 values. */
typedef struct {
    const double *known[2];   /* its frames, idle and gripped; NaN where none is compared */
    int64_t n_known[2];       /* how many of each are no NaN */
    const double *jumps_v;    /* a channel that moves further from frame to frame is disturbed; infinite where unusable */
    const double *weights;    /* of the grip's score */
    const double *directions; /* (n_directions, 896), along which motion is measured */
    ptrdiff_t n_directions;
    Moves steps, grips; /* from frame to frame, and from the idle frame; of none nothing is told of what is unusable */
    unsigned char told[MOST_VALUES];   /* 1 at channels that are told to be usable */
    unsigned char lost[MOST_VALUES];   /* 1 at those that are lost all the same */
    unsigned char usable[MOST_VALUES]; /* told and not lost */
    int unusable[MOST_VALUES], n_unusable; /* the numbers of the others */
} Fingertip;

/* Beyond these a frame is no ordinary one. */
typedef struct {
    ptrdiff_t fewest_at_rail;  /* channels that share its largest value */
    double largest_deviation;  /* by which the middle one of the channels is off from the known frame that is nearer … */
    ptrdiff_t fewest_compared; /* … where so many are compared */
    double lost_share;         /* by which a channel is off from both known frames */
} Limits;

/* Whether nothing speaks against a frame but what may have happened since the frame before: it is finite, none of the channels
   that are told to be usable is at the rail, no others are lost than are known to be, and it is surely of this fingertip. */
int is_ordinary(const Fingertip *tip, const Limits *limits, const double *frame);

/* How many usable channels jump from the frame before. */
int n_jumping(const Fingertip *tip, const double *frame, const double *before);

/* Move the channels that are not usable on from where they were in the frame before, as the usable ones say. */
void fill(const Fingertip *tip, double *channels, const double *before);

/* The grip's score, where `small_v` is added to voltages that others are divided by, the 896 differences to the idle frame at
   the calibration's gain, where the usable ones say what the others are, and where the frame at that gain, and its difference,
   lie along each of the directions. */
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
