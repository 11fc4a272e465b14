/* The bounds, scores and ties of bank/fast_matching.py, for one frame.

   A frame comes after half a second in which others had the processor's caches, and then each call of numpy costs some
   ten microseconds whatever it computes. Here the groups of the compressed bank are gone through from few to many, and
   only what may reach a score that some cell has is looked at: little code and little memory. */

#include "search.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    LANES = 8,
    /* With fewer candidates, scoring them costs less than to bound them anew. */
    FEW_CANDIDATES = 64,
    /* More bounds than this at all lags take longer than numpy, whose products are quicker where much is left. */
    MOST_LOOKS = 1 << 16
};

/* Compiled twice, also for wider registers where the processor has them: the same sums in the same order, bit for bit. */
#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define ALSO_WIDE __attribute__((target_clones("avx2", "default")))
#else
#define ALSO_WIDE
#endif

/* Eight numbers side by side. */
typedef float Eight __attribute__((vector_size(32)));

#define INLINE static inline __attribute__((always_inline))

INLINE void eight(Eight *to, const float *from)
{
    memcpy(to, from, sizeof *to);
}

INLINE float product(const float *a, const float *b, ptrdiff_t n)
{
    Eight sum = {0}, x, y;
    float rest = 0;
    ptrdiff_t whole = n - n % 8;
    for (ptrdiff_t i = 0; i < whole; i += 8) {
        eight(&x, a + i);
        eight(&y, b + i);
        sum += x * y;
    }
    for (ptrdiff_t i = whole; i < n; i++)
        rest += a[i] * b[i];
    return ((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7])) + rest;
}

/* The same for channels: with four sums at once, for each waits for the one before. */
INLINE float over_channels(const float *a, const float *b)
{
    Eight sums[4] = {{0}}, x, y;
    for (int i = 0; i < CHANNELS; i += 32)
        for (int j = 0; j < 4; j++) {
            eight(&x, a + i + 8 * j);
            eight(&y, b + i + 8 * j);
            sums[j] += x * y;
        }
    Eight sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    return ((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7]));
}

ALSO_WIDE static double score_of(const Hunt *hunt, int32_t cell, int32_t lag)
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

static void reaches(Hunt *hunt, double score)
{
    hunt->reached = score;
    hunt->least = (float)(score - hunt->bank->rounding);
}

static void look_up(Hunt *hunt, Candidate *candidate)
{
    candidate->score = score_of(hunt, candidate->cell, candidate->lag);
    hunt->scores_left--;
    if (candidate->score > hunt->reached)
        reaches(hunt, candidate->score);
}

static int may_reach(const Hunt *hunt, float bound)
{
    return bound >= hunt->least;
}

int in_peak_of(const Bank *bank, int32_t cell, int32_t other)
{
    return other >= 0 && labs((long)bank->k_of[cell] - bank->k_of[other]) <= bank->radius
        && labs((long)bank->sigma_of[cell] - bank->sigma_of[other]) <= bank->radius;
}

/* Complete a column of bank/compression.py at a lag: after the frame's first `rank` numbers come the norm of all of these
   but the first, and what is left of the frame. */
static void complete_column(const Hunt *hunt, int32_t lag, ptrdiff_t rank, float *column)
{
    double across = 0;
    for (ptrdiff_t i = 1; i < rank; i++)
        across += (double)column[i] * column[i];
    double left = hunt->energies[CHANNELS + lag] - (double)column[0] * column[0] - across;
    column[rank] = (float)sqrt(across);
    column[rank + 1] = (float)sqrt((left > 0 ? left : 0) + hunt->bank->square_rounding);
}

ALSO_WIDE static void project(const Hunt *hunt, int32_t lag, ptrdiff_t rank, float *column)
{
    for (ptrdiff_t i = 0; i < rank; i++)
        column[i] = over_channels(hunt->bank->basis + i * CHANNELS, hunt->single + CHANNELS + lag);
    complete_column(hunt, lag, rank, column);
}

int take_frame(Hunt *hunt, const Bank *bank, const double *difference)
{
    double *frame = hunt->padded + CHANNELS;
    double largest = 0, sum = 0;
    for (int i = 0; i < CHANNELS; i++) {
        frame[i] = fabs(difference[i]);
        if (frame[i] > largest)
            largest = frame[i];
    }
    if (!(largest > 0 && largest < INFINITY))
        return 0;
    for (int i = 0; i < CHANNELS; i++) {
        /* Scaled by the largest first, so that the squares of no finite input overflow or vanish. */
        frame[i] /= largest;
        sum += frame[i] * frame[i];
    }
    double norm = sqrt(sum);
    /* What is not a number shows here. */
    if (!(norm > 0 && norm < INFINITY))
        return 0;
    memset(hunt->padded, 0, CHANNELS * sizeof(double));
    memset(hunt->padded + 2 * CHANNELS, 0, CHANNELS * sizeof(double));
    memset(hunt->single, 0, sizeof hunt->single);
    sum = 0;
    for (int i = 0; i < CHANNELS; i++) {
        frame[i] /= norm;
        hunt->single[CHANNELS + i] = (float)frame[i];
        hunt->energies[i] = sum;
        hunt->energies[CHANNELS + i] = sum < 1 ? 1 - sum : 0;
        sum += frame[i] * frame[i];
    }
    hunt->bank = bank;
    project(hunt, 0, bank->coarse_rank, hunt->column);
    return 1;
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
    Candidate *found = &bank->candidates[hunt->n_candidates++];
    *found = (Candidate){bound, cell, lag, -1.0};
    if (estimate > hunt->highest) {
        hunt->highest = estimate;
        hunt->likeliest = found;
    }
}

ALSO_WIDE static void look_into(Hunt *hunt, const float *column, int32_t lag, int level, int32_t group)
{
    const Bank *bank = hunt->bank;
    const Level *here = &bank->levels[level];
    int of_cells = level + 1 == bank->n_levels;
    ptrdiff_t rank = bank->coarse_rank, size = rank + 2;
    const float *rows = of_cells ? bank->coarse : bank->levels[level + 1].rows;
    for (int32_t part = here->starts[group]; part < here->starts[group + 1] && hunt->looks_left >= 0; part++) {
        const float *row = rows + part * size;
        float estimate = product(row, column, rank);
        float bound = estimate + row[rank] * column[rank] + row[rank + 1] * column[rank + 1];
        hunt->looks_left--;
        if (!may_reach(hunt, bound))
            continue;
        if (of_cells)
            look_at_cell(hunt, estimate, bound, lag, bank->cells[part]);
        else
            look_into(hunt, column, lag, level + 1, part);
    }
}

static int by_estimate(const void *one, const void *other)
{
    float a = ((const Root *)one)->estimate, b = ((const Root *)other)->estimate;
    return (a < b) - (a > b);
}

static int by_bound(const void *one, const void *other)
{
    float a = ((const Candidate *)one)->bound, b = ((const Candidate *)other)->bound;
    return (a < b) - (a > b);
}

static int by_lag(const void *one, const void *other)
{
    int32_t a = ((const Candidate *)one)->lag, b = ((const Candidate *)other)->lag;
    return (a > b) - (a < b);
}

ALSO_WIDE static void bound_roots(const Hunt *hunt, const float *column)
{
    const Bank *bank = hunt->bank;
    ptrdiff_t rank = bank->coarse_rank;
    for (ptrdiff_t group = 0; group < bank->levels[0].n; group++) {
        const float *row = bank->levels[0].rows + group * (rank + 2);
        float estimate = product(row, column, rank);
        float bound = estimate + row[rank] * column[rank] + row[rank + 1] * column[rank + 1];
        bank->roots[group] = (Root){estimate, bound, (int32_t)group};
    }
    /* A high score is known the sooner. */
    qsort(bank->roots, (size_t)bank->levels[0].n, sizeof(Root), by_estimate);
}

static ptrdiff_t those_that_may_reach(const Hunt *hunt)
{
    Candidate *all = hunt->bank->candidates;
    ptrdiff_t kept = 0;
    for (ptrdiff_t i = 0; i < hunt->n_candidates; i++)
        if (may_reach(hunt, all[i].bound))
            all[kept++] = all[i];
    return kept;
}

/* Bound the candidates anew at each lag that has many: the frame's numbers there cost as much as some scores. */
ALSO_WIDE static void bound_anew(const Hunt *hunt)
{
    const Bank *bank = hunt->bank;
    Candidate *all = bank->candidates;
    float column[MOST_RANK + 2];
    ptrdiff_t n;
    qsort(all, (size_t)hunt->n_candidates, sizeof(Candidate), by_lag);
    for (ptrdiff_t i = 0; i < hunt->n_candidates; i += n) {
        for (n = 1; i + n < hunt->n_candidates && all[i + n].lag == all[i].lag; n++)
            ;
        if (n <= FEW_CANDIDATES)
            continue;
        project(hunt, all[i].lag, bank->fine_rank, column);
        for (ptrdiff_t j = i; j < i + n; j++)
            all[j].bound = product(bank->fine + all[j].cell * (bank->fine_rank + 2), column, bank->fine_rank + 2);
    }
}

static void keep_what_may_reach(Hunt *hunt)
{
    hunt->n_candidates = those_that_may_reach(hunt);
    if (hunt->n_candidates > FEW_CANDIDATES) {
        bound_anew(hunt);
        hunt->n_candidates = those_that_may_reach(hunt);
    }
    /* The highest first: what is scored then leaves out others. */
    qsort(hunt->bank->candidates, (size_t)hunt->n_candidates, sizeof(Candidate), by_bound);
}

/* Of cells that tie the first, and of its lags the one of the highest score. */
static int is_before(const Candidate *one, const Found *found)
{
    return found->cell < 0 || one->cell < found->cell || (one->cell == found->cell && one->score > found->score);
}

Outcome settle(Hunt *hunt, int32_t apart_from, double reached, long most_scores, Found *found)
{
    const Bank *bank = hunt->bank;
    reaches(hunt, reached);
    hunt->scores_left = most_scores;
    *found = (Found){-1, 0};
    for (ptrdiff_t i = 0; i < hunt->n_candidates; i++) {
        Candidate *each = &bank->candidates[i];
        if (!may_reach(hunt, each->bound) || in_peak_of(bank, each->cell, apart_from))
            continue;
        if (each->score < 0) {
            if (hunt->scores_left <= 0)
                return UNDECIDED;
            look_up(hunt, each);
        } else if (each->score > hunt->reached) {
            reaches(hunt, each->score);
        }
    }
    for (ptrdiff_t i = 0; i < hunt->n_candidates; i++) {
        const Candidate *each = &bank->candidates[i];
        double behind = hunt->reached - each->score;
        if (each->score < 0 || in_peak_of(bank, each->cell, apart_from))
            continue;
        if (fabs(behind - bank->tie) < bank->tie_rounding)
            return UNDECIDED;
        if (behind <= bank->tie && is_before(each, found))
            *found = (Found){each->cell, each->score};
    }
    if (found->score > 1)
        found->score = 1;
    return found->cell < 0 ? NONE : FOUND;
}

static void begin(Hunt *hunt, int32_t apart_from, double reached, long most_looks)
{
    hunt->apart_from = apart_from;
    reaches(hunt, reached);
    hunt->highest = -1;
    hunt->looks_left = most_looks;
    hunt->scores_left = 0;
    hunt->n_candidates = 0;
    hunt->likeliest = NULL;
}

static Outcome find_at(Hunt *hunt, const float *column, int32_t lag, int32_t apart_from, long most_scores, Found *found)
{
    const Bank *bank = hunt->bank;
    bound_roots(hunt, column);
    begin(hunt, apart_from, 0, LONG_MAX);
    for (ptrdiff_t i = 0; i < bank->levels[0].n; i++) {
        if (!may_reach(hunt, bank->roots[i].bound))
            continue;
        look_into(hunt, column, lag, 0, bank->roots[i].group);
        /* The higher the score that is known, the more can be left out. */
        if (hunt->likeliest && hunt->likeliest->score < 0)
            look_up(hunt, hunt->likeliest);
    }
    keep_what_may_reach(hunt);
    return settle(hunt, apart_from, hunt->reached, most_scores, found);
}

Outcome find_at_lag_0(Hunt *hunt, int32_t apart_from, long most_scores, Found *found)
{
    return find_at(hunt, hunt->column, 0, apart_from, most_scores, found);
}

int lags_that_may_reach(const Hunt *hunt, double score, int *first, int *end)
{
    const Bank *bank = hunt->bank;
    int n = 0;
    for (int i = 0; i < 2 * CHANNELS; i++) {
        if (bank->overlaps[i] * sqrt(hunt->energies[i]) < score - bank->rounding)
            continue;
        *end = i + 1 - CHANNELS;
        if (!n++)
            *first = i - CHANNELS;
    }
    return n;
}

static void take_parts(const Hunt *hunt, int32_t lag, const float *parts, ptrdiff_t stride, float *column)
{
    for (ptrdiff_t i = 0; i < hunt->bank->coarse_rank; i++)
        column[i] = parts[i * stride];
    complete_column(hunt, lag, hunt->bank->coarse_rank, column);
}

/* One direction at all lags after the other: it stays in the cache meanwhile. */
ALSO_WIDE static void project_at_lags(const Hunt *hunt)
{
    const Bank *bank = hunt->bank;
    for (ptrdiff_t i = 0; i < bank->coarse_rank; i++)
        for (int j = 0; j < hunt->n_lags; j++)
            bank->columns[j * (bank->coarse_rank + 2) + i] =
                over_channels(bank->basis + i * CHANNELS, hunt->single + CHANNELS + hunt->first + j);
}

void take_lags(Hunt *hunt, const float *parts, int first, int end)
{
    const Bank *bank = hunt->bank;
    hunt->first = first;
    hunt->n_lags = end - first;
    if (!parts)
        project_at_lags(hunt);
    for (int j = 0; j < hunt->n_lags; j++) {
        float *column = bank->columns + j * (bank->coarse_rank + 2);
        if (parts)
            take_parts(hunt, first + j, parts + j, hunt->n_lags, column);
        else
            complete_column(hunt, first + j, bank->coarse_rank, column);
    }
    /* bounds = rows columns; BLAS takes a matrix by columns, and so all of them for transposed. */
    int size = (int)bank->coarse_rank + 2, n_groups = (int)bank->levels[0].n;
    float one = 1, none = 0;
    bank->multiply("T", "N", &hunt->n_lags, &n_groups, &size, &one, bank->columns, &size, bank->levels[0].rows, &size,
                   &none, bank->bounds, &hunt->n_lags);
}

/* The highest bound of each lag that is looked at. */
ALSO_WIDE static void highest_bounds(const Hunt *hunt, float *highest)
{
    int n = hunt->n_lags;
    const float *bounds = hunt->bank->bounds;
    memcpy(highest, bounds, (size_t)n * sizeof(float));
    for (ptrdiff_t group = 1; group < hunt->bank->levels[0].n; group++) {
        const float *others = bounds + group * n;
        for (int j = 0; j < n; j++)
            highest[j] = others[j] > highest[j] ? others[j] : highest[j];
    }
}

int likeliest_lag(Hunt *hunt, double score)
{
    const Bank *bank = hunt->bank;
    float highest[2 * CHANNELS];
    int n = hunt->n_lags, kept = 0, likeliest = 0;
    highest_bounds(hunt, highest);
    for (int j = 0; j < n; j++) {
        if ((double)highest[j] < score - bank->rounding)
            continue;
        bank->lags[kept] = j;
        if (highest[j] > highest[bank->lags[likeliest]])
            likeliest = kept;
        kept++;
    }
    hunt->n_left = kept;
    return kept ? bank->lags[likeliest] : -1;
}

Outcome find_at_lag(Hunt *hunt, int number, int32_t apart_from, long most_scores, Found *found)
{
    const float *column = hunt->bank->columns + number * (hunt->bank->coarse_rank + 2);
    return find_at(hunt, column, hunt->first + number, apart_from, most_scores, found);
}

int collect(Hunt *hunt, double score)
{
    const Bank *bank = hunt->bank;
    /* No score is looked up meanwhile: the runner-up's must not be raised by the best cell's. */
    begin(hunt, -1, score, MOST_LOOKS);
    for (ptrdiff_t group = 0; group < bank->levels[0].n && hunt->looks_left >= 0; group++)
        for (int i = 0; i < hunt->n_left; i++) {
            int number = bank->lags[i];
            if (may_reach(hunt, bank->bounds[group * hunt->n_lags + number]))
                look_into(hunt, bank->columns + number * (bank->coarse_rank + 2), hunt->first + number, 0,
                          (int32_t)group);
        }
    if (hunt->looks_left < 0)
        return 0;
    keep_what_may_reach(hunt);
    return 1;
}
