# Stage targets, for this Makefile or another project's: set WBM (the command), WBM_ARGS (settings) and WBM_ROOT, include
# this file, and depend on `assets` ... `bundle`, or on a reference file such as $(call wbm_latest,student/main).
# A target asks `wbm plan --check` whether its artifact is up to date and runs what is missing. A reference file changes
# only when the artifact it names changes, so rules that depend on it run only then.
WBM ?= wbm
WBM_ARGS ?=
WBM_ROOT ?= artifacts
WBM_STAGES := prepare-assets train-teacher generate-rollouts distill evaluate deploy-export

wbm_latest = $(WBM_ROOT)/.store/refs/$(1)/latest
wbm_until = $(WBM) plan --check --until $(1) artifacts.root=$(WBM_ROOT) $(WBM_ARGS) || \
	$(WBM) run --until $(1) artifacts.root=$(WBM_ROOT) $(WBM_ARGS)

.PHONY: assets teachers rollouts student evaluation bundle $(WBM_STAGES) wbm-always
assets prepare-assets: ; @$(call wbm_until,prepare-assets)
teachers train-teacher: ; @$(call wbm_until,train-teacher)
rollouts generate-rollouts: ; @$(call wbm_until,generate-rollouts)
student distill: ; @$(call wbm_until,distill)
evaluation evaluate: ; @$(call wbm_until,evaluate)
bundle deploy-export: ; @$(call wbm_until,deploy-export)

$(WBM_ROOT)/.store/refs/assets/%/latest: wbm-always ; @$(call wbm_until,prepare-assets)
$(WBM_ROOT)/.store/refs/teacher/%/latest: wbm-always ; @$(call wbm_until,train-teacher)
$(WBM_ROOT)/.store/refs/rollouts/%/latest: wbm-always ; @$(call wbm_until,generate-rollouts)
$(WBM_ROOT)/.store/refs/student/%/latest: wbm-always ; @$(call wbm_until,distill)
$(WBM_ROOT)/.store/refs/evaluation/%/latest: wbm-always ; @$(call wbm_until,evaluate)
$(WBM_ROOT)/.store/refs/bundle/%/latest: wbm-always ; @$(call wbm_until,deploy-export)
