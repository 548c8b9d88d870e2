// Exceptions of parallel regions, which must not leave them: that would end the process.
#pragma once

#include <exception>
#include <utility>

// Keeps the first that is thrown inside, for behind the region: Python gets a MemoryError, or what else it was.
class Caught {
   public:
    template <class Work>
    void operator()(Work&& work) noexcept {
        try {
            std::forward<Work>(work)();
        } catch (...) {
#pragma omp critical(mvsgs_caught)
            if (!first_) first_ = std::current_exception();
        }
    }
    bool any() const { return bool(first_); }  // not while others may throw
    void rethrow() const {
        if (first_) std::rethrow_exception(first_);
    }

   private:
    std::exception_ptr first_;
};
