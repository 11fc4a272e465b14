/* What a frame looks like to who knows its fingertip: whether it is an ordinary one, and where it lies.

   Sums are taken in four parts, in the same order on every machine. */

#include "look.h"

#include <math.h>
#include <string.h>

enum { PARTS = 4 };

int are_finite(const double *values, ptrdiff_t n)
{
    ptrdiff_t n_finite = 0;
    for (ptrdiff_t i = 0; i < n; i++)
        n_finite += isfinite(values[i]) != 0;
    return n_finite == n;
}

static double product(const double *a, const double *b)
{
    double sums[PARTS] = {0};
    for (int i = 0; i < MOST_VALUES; i += PARTS)
        for (int j = 0; j < PARTS; j++)
            sums[j] += a[i + j] * b[i + j];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

/* How many channels that are told to be usable read the largest value of them. */
static int n_at_rail(const Fingertip *tip, const double *frame)
{
    double heights[MOST_VALUES];
    if (!tip->n_unusable)
        return n_largest_of(frame);
    for (int i = 0; i < MOST_VALUES; i++)
        heights[i] = tip->told[i] ? frame[i] : -INFINITY;
    return n_largest_of(heights);
}

int is_ordinary(const Fingertip *tip, const Limits *limits, const double *frame)
{
    double off[2][MOST_VALUES];
    int n_others = 0, is_known = 0;
    if (!are_finite(frame, MOST_VALUES) || n_at_rail(tip, frame) >= limits->fewest_at_rail)
        return 0;
    for (int i = 0; i < 2; i++) {
        int64_t n_compared = tip->n_known[i];
        int n_near = 0;
        compare(tip->known[i], frame, n_compared, off[i]);
        for (int j = 0; j < MOST_VALUES; j++)
            n_near += off[i][j] <= limits->largest_deviation;
        is_known |= n_compared >= limits->fewest_compared && n_near > n_compared / 2;
    }
    for (int i = 0; i < MOST_VALUES; i++)
        n_others += ((off[0][i] > limits->lost_share) & (off[1][i] > limits->lost_share)) != tip->lost[i];
    return is_known && n_others == 0;
}

int n_jumping(const Fingertip *tip, const double *frame, const double *before)
{
    int n = 0;
    for (int i = 0; i < MOST_VALUES; i++)
        n += fabs(frame[i] - before[i]) > tip->jumps_v[i];
    return n;
}

/* What the usable channels say of how far each of the others has moved, in their order. */
static void tell(const Fingertip *tip, const Moves *moves, const double *moved, double *said)
{
    memset(said, 0, (size_t)tip->n_unusable * sizeof(double));
    for (ptrdiff_t i = 0; i < moves->n; i++) {
        const double *shape = moves->shapes + i * MOST_VALUES;
        double along = product(moved, moves->reads + i * MOST_VALUES);
        for (int j = 0; j < tip->n_unusable; j++)
            said[j] += along * shape[tip->unusable[j]];
    }
}

void fill(const Fingertip *tip, double *channels, const double *before)
{
    double moved[MOST_VALUES], said[MOST_VALUES];
    for (int i = 0; i < MOST_VALUES; i++)
        moved[i] = channels[i] - before[i];
    tell(tip, &tip->steps, moved, said);
    for (int j = 0; j < tip->n_unusable; j++)
        channels[tip->unusable[j]] = before[tip->unusable[j]] + said[j];
}

double place(const Fingertip *tip, double small_v, const double *frame, const double *idle, double gain, double *difference,
             double *places, double *placed)
{
    double moved[MOST_VALUES], scaled[MOST_VALUES], relative[MOST_VALUES], said[MOST_VALUES];
    for (int i = 0; i < MOST_VALUES; i++) {
        moved[i] = frame[i] - idle[i];
        relative[i] = moved[i] / (idle[i] + small_v);
        difference[i] = moved[i] / gain;
        scaled[i] = frame[i] / gain;
    }
    if (tip->grips.n) {
        tell(tip, &tip->grips, moved, said);
        for (int j = 0; j < tip->n_unusable; j++)
            difference[tip->unusable[j]] = said[j] / gain;
    }
    for (ptrdiff_t i = 0; i < tip->n_directions; i++) {
        places[i] = product(scaled, tip->directions + i * MOST_VALUES);
        placed[i] = product(difference, tip->directions + i * MOST_VALUES);
    }
    return product(relative, tip->weights);
}

double weighed(const double *values, const double *mean, const double *weights, ptrdiff_t n)
{
    double sums[PARTS] = {0};
    for (ptrdiff_t i = 0; i < n; i++)
        sums[i % PARTS] += (values[i] - mean[i]) * weights[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

ptrdiff_t n_beyond(const double *values, const double *centre, const double *reach, double times, ptrdiff_t n)
{
    ptrdiff_t found = 0;
    for (ptrdiff_t i = 0; i < n; i++)
        found += fabs(values[i] - centre[i]) > times * reach[i];
    return found;
}

void add_to_mean(double *mean, const double *values, double n_rows, ptrdiff_t n)
{
    for (ptrdiff_t i = 0; i < n; i++)
        mean[i] += (values[i] - mean[i]) / n_rows;
}
