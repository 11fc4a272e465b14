#ifndef MEDIANS_H
#define MEDIANS_H

#include <stdint.h>

enum { MOST_VALUES = 896 };

/* The mean of the two in the middle of n, where the 896 values of a row are in order with all NaN behind them: NaN where
   one of the two is, 0 of n < 1. */
double median_of(const double *row, int64_t n);

/* By which shares of a known row's values a row is off from them after the gain in common, the median of its n first ratios to
   them: NaN where the known one is, and all NaN without a gain. */
void compare(const double *known, const double *row, int64_t n, double *off);

/* How many of the 896 values of a row are its largest; NaN are none. */
int n_largest_of(const double *row);

#endif
