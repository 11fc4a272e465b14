/* Medians of a frame's channels: what is left of a sort, whose code for wide registers is long, and cold when a frame comes.

   A value is sought by parting what may be it by a pivot, without branches: into what is below, and what is above. */

#include "medians.h"

#include <math.h>

enum { FEW = 16 };

static double nth_of_few(double *values, int n, int nth)
{
    for (int i = 1; i < n; i++) {
        double value = values[i];
        int place = i;
        for (; place > 0 && values[place - 1] > value; place--)
            values[place] = values[place - 1];
        values[place] = value;
    }
    return values[nth];
}

/* One of n values, about as many of which are below it as are below the nth. */
static double pivot_for(const double *values, int n, int nth)
{
    double some[FEW];
    for (int i = 0; i < FEW; i++)
        some[i] = values[i * n / FEW];
    return nth_of_few(some, FEW, nth * FEW / n);
}

/* The nth of n values in order, from 0, none of which is NaN. */
static double nth_in_order(double *values, int n, int nth, double *below, double *above)
{
    while (n > FEW) {
        double pivot = pivot_for(values, n, nth);
        int n_below = 0, n_above = 0;
        for (int i = 0; i < n; i++) {
            double value = values[i];
            below[n_below] = value;
            n_below += value < pivot;
            above[n_above] = value;
            n_above += value > pivot;
        }
        int n_not_above = n - n_above;
        double *parted = values;
        if (nth < n_below) {
            values = below;
            below = parted;
            n = n_below;
        } else if (nth >= n_not_above) {
            values = above;
            above = parted;
            n = n_above;
            nth -= n_not_above;
        } else {
            return pivot;
        }
    }
    return nth_of_few(values, n, nth);
}

int n_largest_of(const double *row)
{
    int n = 0;
    double largest = -INFINITY;
    for (int i = 0; i < MOST_VALUES; i++)
        largest = row[i] > largest ? row[i] : largest;
    for (int i = 0; i < MOST_VALUES; i++)
        n += row[i] == largest;
    return n;
}

double median_of(const double *row, int64_t n)
{
    double values[MOST_VALUES], below[MOST_VALUES], above[MOST_VALUES];
    int n_values = 0, n_up_to = 0;
    for (int i = 0; i < MOST_VALUES; i++) {
        values[n_values] = row[i];
        n_values += !isnan(row[i]);
    }
    if (n < 1)
        return 0.0;
    if (n / 2 >= n_values)
        return NAN;
    double lower = nth_in_order(values, n_values, (int)((n - 1) / 2), below, above), higher = INFINITY;
    if (n % 2)
        return lower;
    /* The next one is as large where there are more of them than come before it. */
    for (int i = 0; i < MOST_VALUES; i++) {
        double beyond = row[i] > lower ? row[i] : INFINITY;
        n_up_to += row[i] <= lower;
        higher = beyond < higher ? beyond : higher;
    }
    return (lower + (n_up_to > n / 2 ? lower : higher)) / 2;
}

void compare(const double *known, const double *row, int64_t n, double *off)
{
    for (int i = 0; i < MOST_VALUES; i++)
        off[i] = row[i] / known[i];
    double gain = median_of(off, n);
    if (!(gain > 0))
        gain = NAN;
    for (int i = 0; i < MOST_VALUES; i++)
        off[i] = fabs(row[i] / gain - known[i]) / known[i];
}
