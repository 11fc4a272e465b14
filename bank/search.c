/* The bounds, scores and ties of bank/fast_matching.py, for one frame.

   A frame comes after half a second in which others had the processor's caches, and then each call of numpy costs some
   ten microseconds whatever it computes. Here the groups of the compressed bank are gone through from few to many, and
   only what may reach a score that some cell has is looked at: little code and little memory. */

#include "search.h"

#include <limits.h>
#include <math.h>
#include <string.h>

enum {
    /* More blocks than this at all lags take longer than numpy, whose products are quicker where much is left. */
    MOST_LOOKS = 1 << 16,
    /* So many lags are looked at in the order of their bounds: what is found there leaves out most of the others. */
    LIKELY_LAGS = 8,
    /* And at lag 0 so many groups in the order of their estimates. */
    LIKELY_ROOTS = 3
};

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
    project(hunt, 0, 0, bank->coarse_rank, hunt->column);
    memset(hunt->column + bank->coarse_rank, 0, (size_t)(bank->width - bank->coarse_rank) * sizeof(float));
    complete_column(hunt, 0, bank->width, hunt->column);
    return 1;
}

static void look_up(Hunt *hunt, Candidate *candidate)
{
    candidate->score = score_of(hunt, candidate->cell, candidate->lag);
    hunt->scores_left--;
    if (candidate->score > hunt->reached)
        reaches(hunt, candidate->score);
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
    hunt->looks_left = most_looks;
    hunt->scores_left = 0;
    hunt->n_candidates = 0;
}

/* Of the groups that may still hold something, the one of the highest estimate; -1 where there is none. */
static ptrdiff_t next_root(const Hunt *hunt)
{
    const Bank *bank = hunt->bank;
    ptrdiff_t found = -1;
    for (ptrdiff_t i = 0; i < bank->levels[0].n * LANES; i++)
        if (may_reach(hunt, bank->root_bounds[i]) && (found < 0 || bank->root_estimates[i] > bank->root_estimates[found]))
            found = i;
    return found;
}

/* Look into n groups of the first level, which are listed, and look up the likeliest of the cells that are found. */
static void look_at_lag_0(Hunt *hunt, ptrdiff_t n)
{
    ptrdiff_t from = hunt->n_candidates;
    look_into(hunt, hunt->column, 0, 0, n);
    Candidate *best = likeliest(hunt, from, -1, hunt->least);
    if (best)
        look_up(hunt, best);
}

Outcome find_at_lag_0(Hunt *hunt, int32_t apart_from, long most_scores, Found *found)
{
    const Bank *bank = hunt->bank;
    begin(hunt, apart_from, 0, LONG_MAX);
    bound_roots(hunt, hunt->column);
    /* The higher the score that is known, the more can be left out. */
    for (ptrdiff_t turn = 0, root; turn < LIKELY_ROOTS && (root = next_root(hunt)) >= 0; turn++) {
        bank->root_bounds[root] = -INFINITY;
        bank->lists[0][0] = bank->levels[0].parts[root];
        look_at_lag_0(hunt, 1);
    }
    ptrdiff_t n = 0;
    for (ptrdiff_t i = 0; i < bank->levels[0].n; i++)
        n = list_parts(hunt, bank->root_bounds + i * LANES, bank->levels[0].parts + i * LANES, bank->lists[0], n);
    look_at_lag_0(hunt, n);
    bound_anew(hunt, hunt->column, 0, 0);
    sort_candidates(hunt);
    return settle(hunt, apart_from, hunt->reached, most_scores, found);
}

/* The highest score that is known of a cell outside the peak of another; -1 where none is. */
static double highest_apart(const Hunt *hunt, int32_t cell)
{
    double highest = -1;
    for (int i = 0; i < hunt->n_known; i++)
        if (!in_peak_of(hunt->bank, hunt->known[i].cell, cell) && hunt->known[i].score > highest)
            highest = hunt->known[i].score;
    return highest;
}

/* Look up a score; where it is higher than is known, less may reach what is looked for. */
static void learn(Hunt *hunt, Candidate *candidate, int with_runner_up, int is_settled)
{
    Found *found = &hunt->known[hunt->n_known];
    candidate->score = score_of(hunt, candidate->cell, candidate->lag);
    if (hunt->n_known == MOST_KNOWN)
        return;
    *found = (Found){candidate->cell, candidate->score};
    hunt->n_known++;
    if (!is_settled && found->score > hunt->best.score)
        hunt->best = *found;
    double reached = with_runner_up ? highest_apart(hunt, hunt->best.cell) : hunt->best.score;
    if (reached > hunt->reached)
        reaches(hunt, reached);
}

/* Collect the cells that may reach, at one of the lags, what is known. */
static void collect_at(Hunt *hunt, int number, int with_runner_up, int is_settled)
{
    const Bank *bank = hunt->bank;
    ptrdiff_t from = hunt->n_candidates, n_groups = bank->levels[0].n * LANES;
    const float *column = bank->columns + number * (bank->width + 2), *bounds = bank->bounds + number * n_groups;
    int32_t lag = hunt->first + number;
    ptrdiff_t n = 0;
    for (ptrdiff_t i = 0; i < n_groups; i += LANES)
        n = list_parts(hunt, bounds + i, bank->levels[0].parts + i, bank->lists[0], n);
    look_into(hunt, column, lag, 0, n);
    if (hunt->n_candidates == from || hunt->looks_left < 0)
        return;
    Candidate *best = likeliest(hunt, from, -1, (float)(hunt->best.score - bank->rounding));
    if (best)
        learn(hunt, best, with_runner_up, is_settled);
    Candidate *other = with_runner_up ? likeliest(hunt, from, hunt->best.cell, hunt->least) : NULL;
    if (other)
        learn(hunt, other, with_runner_up, is_settled);
    bound_anew(hunt, column, lag, from);
}

/* Collect what may reach a score at any lag, and score some of it. 0 where there is too much. */
static int collect(Hunt *hunt, double score, int with_runner_up, int is_settled)
{
    begin(hunt, -1, score, MOST_LOOKS);
    for (int turn = 0; turn < LIKELY_LAGS; turn++) {
        int highest = 0;
        for (int i = 1; i < hunt->n_lags; i++)
            if (hunt->highest[i] > hunt->highest[highest])
                highest = i;
        if (!may_reach(hunt, hunt->highest[highest]))
            break;
        collect_at(hunt, highest, with_runner_up, is_settled);
        hunt->highest[highest] = -INFINITY;
    }
    for (int i = 0; i < hunt->n_lags && hunt->looks_left >= 0; i++)
        if (may_reach(hunt, hunt->highest[i]))
            collect_at(hunt, i, with_runner_up, is_settled);
    hunt->collected = hunt->reached;
    keep_what_may_reach(hunt, 0);
    sort_candidates(hunt);
    return hunt->looks_left >= 0;
}

Outcome find_at_all_lags(Hunt *hunt, long most_scores, Found *best, Found *other)
{
    const int with_runner_up = other != NULL;
    for (int i = 0; i <= with_runner_up; i++)
        if (find_at_lag_0(hunt, i ? hunt->known[0].cell : -1, most_scores, &hunt->known[i]) != FOUND)
            return UNDECIDED;
    hunt->n_known = 1 + with_runner_up;
    hunt->best = hunt->known[0];
    double least = hunt->known[with_runner_up].score;
    if (!take_lags(hunt, least) || !collect(hunt, least, with_runner_up, 0)
        || settle(hunt, -1, hunt->best.score, most_scores, best) != FOUND)
        return UNDECIDED;
    if (!with_runner_up)
        return FOUND;
    least = highest_apart(hunt, best->cell);
    if (least < hunt->collected) {
        /* It is another one than was thought, with the known runner-up in its peak: once more, from further down, where
           lags that were left out may have it. */
        hunt->best = *best;
        if (!take_lags(hunt, least) || !collect(hunt, least, 1, 1))
            return UNDECIDED;
        least = hunt->collected;
    }
    return settle(hunt, best->cell, least, most_scores, other);
}
