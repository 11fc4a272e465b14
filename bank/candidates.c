/* What of a bank may reach a score that is known: groups and cells are bounded, and the cells that are left are candidates. */

#include "eight.h"

#include <math.h>
#include <stdlib.h>

enum {
    /* With fewer candidates, scoring them costs less than to bound them anew. */
    FEW_CANDIDATES = 64,
    /* So many groups before it is its turn, a group's first block is asked for: bounding one takes a tenth of fetching it. */
    AHEAD = 2
};

ALSO_WIDE double score_of(const Hunt *hunt, int32_t cell, int32_t lag)
{
    const Bank *bank = hunt->bank;
    const float *signal = bank->signals + bank->places[cell] * CHANNELS;
    const double *frame = hunt->padded + CHANNELS + lag;
    double lanes[LANES] = {0};
    double sum = 0;
    for (int i = 0; i < CHANNELS; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += frame[i + lane] * fabs((double)signal[i + lane]);
    for (int lane = 0; lane < LANES; lane++)
        sum += lanes[lane];
    return sum / bank->norms[cell];
}

void reaches(Hunt *hunt, double score)
{
    hunt->reached = score;
    hunt->least = (float)(score - hunt->bank->rounding);
}

int in_peak_of(const Bank *bank, int32_t cell, int32_t other)
{
    return other >= 0 && labs((long)bank->k_of[cell] - bank->k_of[other]) <= bank->radius
        && labs((long)bank->sigma_of[cell] - bank->sigma_of[other]) <= bank->radius;
}

ALSO_WIDE void project(const Hunt *hunt, int32_t lag, ptrdiff_t from, ptrdiff_t rank, float *column)
{
    for (ptrdiff_t i = from; i < rank; i++)
        column[i] = over_channels(hunt->bank->basis + i * CHANNELS, hunt->single + CHANNELS + lag);
}

INLINE void bound_block(const Bank *bank, const float *block, const float *column, float *estimates, float *bounds)
{
    ptrdiff_t width = bank->width;
    Eight sums[4] = {{0}}, row;
    for (ptrdiff_t i = 0; i < width; i += 4)
        for (int j = 0; j < 4; j++) {
            eight(&row, block + LANES * (i + j));
            sums[j] += row * column[i + j];
        }
    Eight sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    memcpy(estimates, &sum, sizeof sum);
    eight(&row, block + LANES * width);
    sum += row * column[width];
    eight(&row, block + LANES * (width + 1));
    sum += row * column[width + 1];
    memcpy(bounds, &sum, sizeof sum);
}

ALSO_WIDE void bound_roots(const Hunt *hunt, const float *column)
{
    const Bank *bank = hunt->bank;
    const Level *roots = &bank->levels[0];
    for (ptrdiff_t i = 0; i < roots->n; i++)
        bound_block(bank, roots->blocks + i * LANES * (bank->width + 2), column, bank->root_estimates + i * LANES,
                    bank->root_bounds + i * LANES);
}

static void look_at_cell(Hunt *hunt, float estimate, float bound, int32_t lag, int32_t cell)
{
    const Bank *bank = hunt->bank;
    if (in_peak_of(bank, cell, hunt->apart_from))
        return;
    if (hunt->n_candidates == bank->most_candidates) {
        hunt->looks_left = -1;
        return;
    }
    bank->candidates[hunt->n_candidates++] = (Candidate){bound, estimate, cell, lag, -1.0};
}

/* Ask for a block before it is needed. */
INLINE void fetch(const float *block, ptrdiff_t size)
{
    for (ptrdiff_t i = 0; i < size; i += 16)
        __builtin_prefetch(block + i);
}

ALSO_WIDE void look_into(Hunt *hunt, const float *column, int32_t lag, int level, ptrdiff_t n)
{
    const Bank *bank = hunt->bank;
    float estimates[LANES], bounds[LANES];
    const ptrdiff_t size = LANES * (bank->width + 2);
    while (n && ++level <= bank->n_levels) {
        const Level *parts = &bank->levels[level];
        const int32_t *groups = bank->lists[(level + 1) % 2];
        int32_t *found = bank->lists[level % 2];
        ptrdiff_t n_groups = n;
        n = 0;
        for (ptrdiff_t each = 0; each < n_groups; each++) {
            const ptrdiff_t end = parts->starts[groups[each] + 1];
            if (each + AHEAD < n_groups)
                fetch(parts->blocks + parts->starts[groups[each + AHEAD]] * size, size);
            for (ptrdiff_t i = parts->starts[groups[each]]; i < end && n + LANES <= bank->most_listed; i++) {
                bound_block(bank, parts->blocks + i * size, column, estimates, bounds);
                hunt->looks_left--;
                if (level < bank->n_levels) {
                    n = list_parts(hunt, bounds, parts->parts + i * LANES, found, n);
                    continue;
                }
                for (int lane = 0; lane < LANES; lane++)
                    if (may_reach(hunt, bounds[lane]))
                        look_at_cell(hunt, estimates[lane], bounds[lane], lag, parts->parts[i * LANES + lane]);
            }
        }
    }
}

void keep_what_may_reach(Hunt *hunt, ptrdiff_t from)
{
    Candidate *all = hunt->bank->candidates;
    ptrdiff_t kept = from;
    for (ptrdiff_t i = from; i < hunt->n_candidates; i++)
        if (may_reach(hunt, all[i].bound))
            all[kept++] = all[i];
    hunt->n_candidates = kept;
}

ALSO_WIDE void bound_anew(Hunt *hunt, const float *coarse, int32_t lag, ptrdiff_t from)
{
    const Bank *bank = hunt->bank;
    float column[MOST_RANK + 2];
    keep_what_may_reach(hunt, from);
    if (hunt->n_candidates - from <= FEW_CANDIDATES)
        return;
    memcpy(column, coarse, (size_t)bank->coarse_rank * sizeof(float));
    project(hunt, lag, bank->coarse_rank, bank->fine_rank, column);
    complete_column(hunt, lag, bank->fine_rank, column);
    for (Candidate *each = bank->candidates + from; each < bank->candidates + hunt->n_candidates; each++)
        each->bound = product(bank->fine + each->cell * (bank->fine_rank + 2), column, bank->fine_rank + 2);
    keep_what_may_reach(hunt, from);
}

Candidate *likeliest(const Hunt *hunt, ptrdiff_t from, int32_t apart_from, float least)
{
    Candidate *found = NULL;
    for (Candidate *each = hunt->bank->candidates + from; each < hunt->bank->candidates + hunt->n_candidates; each++)
        if (each->bound >= least && each->score < 0 && (!found || each->estimate > found->estimate)
            && !in_peak_of(hunt->bank, each->cell, apart_from))
            found = each;
    return found;
}

static int by_bound(const void *one, const void *other)
{
    float a = ((const Candidate *)one)->bound, b = ((const Candidate *)other)->bound;
    return (a < b) - (a > b);
}

void sort_candidates(Hunt *hunt)
{
    qsort(hunt->bank->candidates, (size_t)hunt->n_candidates, sizeof(Candidate), by_bound);
}
